"""The launch file's arguments and what they mean, without launch: the wheels do not have it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast, get_args

from ament_index_python.packages import get_packages_with_prefixes

from crash_coach_bringup.ros.graph import GraphError, Layout, Mode, UpOptions

MODES: tuple[str, ...] = get_args(Mode)
LAYOUTS: tuple[str, ...] = ("nodes", "team")  # a single process has no executables to launch


@dataclass(frozen=True)
class LaunchArgument:
    """``default`` None: the argument has to be given. ``choices`` empty: any text."""

    name: str
    description: str
    default: str | None = None
    choices: tuple[str, ...] = ()


ARGUMENTS = (
    LaunchArgument("scenario", "Scenario name or YAML file.", "buttons"),
    LaunchArgument("checkpoint", "Run directory, RUN@best, or checkpoint directory of the team."),
    LaunchArgument("mode", "By the clock, or as fast as every robot answers.", "realtime", MODES),
    LaunchArgument("layout", "A policy process per robot, or one for the team.", "nodes", LAYOUTS),
    LaunchArgument("seed", "Seed of episodes and crashes.", "0"),
    LaunchArgument("episodes", "End after this many episodes; 0: run on.", "0"),
    LaunchArgument("namespace", "Of every name of the graph.", ""),
    LaunchArgument("rviz", "Also start RViz.", "false", ("true", "false")),
)


def options_from(values: Mapping[str, str]) -> UpOptions:
    """The graph that the launch arguments ask for.

    Raises:
        GraphError: naming a wrong value, or RViz where it is asked for and not installed: before
            anything is started.
    """
    if values["rviz"] == "true" and "rviz2" not in get_packages_with_prefixes():
        raise GraphError("rviz:=true, but package rviz2 is not installed; leave it out, or install")
    return UpOptions(
        scenario=values["scenario"],
        checkpoint=Path(values["checkpoint"]),
        mode=cast(Mode, values["mode"]),
        layout=cast(Layout, values["layout"]),
        seed=_count("seed", values["seed"]),
        episodes=_count("episodes", values["episodes"]),
        namespace=values["namespace"],
    )


def _count(name: str, text: str) -> int:
    if not text.isdecimal():
        raise GraphError(f"launch argument {name}:={text} is not a whole number from 0")
    return int(text)
