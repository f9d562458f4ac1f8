"""The graph of `crash-coach up`, for ``ros2 launch crash_coach_bringup team.launch.py``."""

from __future__ import annotations

from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.conditions import IfCondition
from launch.launch_context import LaunchContext
from launch.launch_description import LaunchDescription
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from crash_coach_bringup.ros.graph import check_team, graph_nodes
from crash_coach_bringup.ros.launch_arguments import ARGUMENTS, options_from


def generate_launch_description() -> LaunchDescription:
    arguments = [
        DeclareLaunchArgument(
            argument.name,
            default_value=argument.default,
            description=argument.description,
            choices=list(argument.choices) or None,
        )
        for argument in ARGUMENTS
    ]
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=[
            "-d",
            PathJoinSubstitution([FindPackageShare("crash_coach_bringup"), "rviz", "team.rviz"]),
        ],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription([*arguments, OpaqueFunction(function=team), rviz])


def team(context: LaunchContext) -> list[Node]:
    """The nodes; whichever ends, ends them all."""
    options = options_from(
        {a.name: LaunchConfiguration(a.name).perform(context) for a in ARGUMENTS}
    )
    return [
        Node(
            package=node.package,
            executable=node.executable,
            name=node.name,
            namespace=node.namespace,
            # Text stays text: launch would read a run directory named 1e3 as a number.
            parameters=[
                {
                    name: ParameterValue(value, value_type=str) if isinstance(value, str) else value
                    for name, value in node.parameters.items()
                }
            ],
            output="both",
            on_exit=Shutdown(reason=f"{node.name} ended"),
        )
        for node in graph_nodes(options, check_team(options))
    ]
