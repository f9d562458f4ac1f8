"""Our arguments and nodes as launch's: for the launch files alone, as the wheels have no launch."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.launch_context import LaunchContext
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node as LaunchNode
from launch_ros.parameter_descriptions import ParameterValue

from crash_coach_bringup.ros.graph import Node
from crash_coach_bringup.ros.launch_arguments import LaunchArgument


def declared(arguments: Iterable[LaunchArgument]) -> list[DeclareLaunchArgument]:
    """For ``ros2 launch --show-args`` too."""
    return [
        DeclareLaunchArgument(
            argument.name,
            default_value=argument.default,
            description=argument.description,
            choices=list(argument.choices) or None,
        )
        for argument in arguments
    ]


def given(context: LaunchContext, arguments: Iterable[LaunchArgument]) -> dict[str, str]:
    """Their values."""
    return {a.name: LaunchConfiguration(a.name).perform(context) for a in arguments}


def launched(nodes: Sequence[Node]) -> list[LaunchNode]:
    """Whichever ends, ends them all."""
    return [
        LaunchNode(
            package=node.package,
            executable=node.executable,
            name=node.name,
            namespace=node.namespace,
            parameters=[
                # Text stays text: launch would read a run directory named 1e3 as a number.
                {
                    name: ParameterValue(value, value_type=str) if isinstance(value, str) else value
                    for name, value in node.parameters.items()
                },
                *([str(node.params_file)] if node.params_file else []),  # later values win
            ],
            ros_arguments=["--log-level", node.log_level],
            output="both",
            on_exit=Shutdown(reason=f"{node.name} ended"),
        )
        for node in nodes
    ]
