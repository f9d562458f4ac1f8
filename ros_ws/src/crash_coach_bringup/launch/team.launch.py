"""The graph of `crash-coach up`, for ``ros2 launch crash_coach_bringup team.launch.py``."""

from __future__ import annotations

from launch.actions import OpaqueFunction
from launch.conditions import IfCondition
from launch.launch_context import LaunchContext
from launch.launch_description import LaunchDescription
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from crash_coach_bringup.ros.graph import check_team, graph_nodes
from crash_coach_bringup.ros.launch_arguments import ARGUMENTS, options_from
from crash_coach_bringup.ros.launch_nodes import declared, given, launched


def generate_launch_description() -> LaunchDescription:
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=[
            "-d",
            PathJoinSubstitution([FindPackageShare("crash_coach_bringup"), "rviz", "team.rviz"]),
        ],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription([*declared(ARGUMENTS), OpaqueFunction(function=team), rviz])


def team(context: LaunchContext) -> list[Node]:
    """The nodes; whichever ends, ends them all."""
    options = options_from(given(context, ARGUMENTS))
    return launched(graph_nodes(options, check_team(options)))
