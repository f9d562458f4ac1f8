"""Gate and coach in front of robots of your own, one or many: what `crash-coach gate` starts.

    ros2 launch crash_coach_bringup own_robots.launch.py robots:=rover_1,rover_2
    ros2 launch crash_coach_bringup own_robots.launch.py params_file:=own_robots.yaml

A parameter file to begin with is config/own_robots.yaml of this package's share folder.
"""

from __future__ import annotations

from launch.actions import OpaqueFunction
from launch.launch_context import LaunchContext
from launch.launch_description import LaunchDescription
from launch_ros.actions import Node

from crash_coach_bringup.ros.launch_arguments import OWN_ARGUMENTS, own_from
from crash_coach_bringup.ros.launch_nodes import declared, given, launched
from crash_coach_bringup.ros.own_robots import own_nodes


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription([*declared(OWN_ARGUMENTS), OpaqueFunction(function=team)])


def team(context: LaunchContext) -> list[Node]:
    """Gate and coach; whichever ends, ends both."""
    return launched(own_nodes(own_from(given(context, OWN_ARGUMENTS))))
