"""The launch files' arguments and what they mean, without launch: the wheels do not have it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict, cast, get_args

from ament_index_python.packages import get_packages_with_prefixes

from crash_coach_bringup.ros.graph import GraphError, Layout, Mode, UpOptions
from crash_coach_bringup.ros.own_robots import OwnRobots
from crash_coach_pkg.coach.fault_scenario import find_fault_scenario
from policy_pkg.play.conditions import at_rate

MODES: tuple[str, ...] = get_args(Mode)
LAYOUTS: tuple[str, ...] = ("nodes", "team")  # a single process has no executables to launch


@dataclass(frozen=True)
class LaunchArgument:
    """``default`` None: the argument has to be given. ``choices`` empty: any text."""

    name: str
    description: str
    default: str | None = None
    choices: tuple[str, ...] = ()


FLAGS = ("true", "false")
LEVELS = ("debug", "info", "warn", "error", "fatal")
NAMESPACE = LaunchArgument("namespace", "Of every name of the graph.", "")
COMMON = (
    LaunchArgument("params_file", "ROS parameter file for every node; its values win.", ""),
    LaunchArgument("use_sim_time", "Nodes take the time from /clock.", "false", FLAGS),
    LaunchArgument("log_level", "Of every node's log.", "info", LEVELS),
    LaunchArgument("fault_scenario", "By name or path: who crashes, when and how.", ""),
)
ARGUMENTS = (
    LaunchArgument("scenario", "Scenario name or YAML file.", "buttons"),
    LaunchArgument("checkpoint", "Run directory, RUN@best, or checkpoint directory of the team."),
    LaunchArgument("mode", "By the clock, or as fast as every robot answers.", "realtime", MODES),
    LaunchArgument("layout", "A policy process per robot, or one for the team.", "nodes", LAYOUTS),
    LaunchArgument("seed", "Seed of episodes and crashes.", "0"),
    LaunchArgument("episodes", "End after this many episodes; 0: run on.", "0"),
    LaunchArgument("crash_rate", "Each robot is mute in an episode with this probability.", "0.0"),
    LaunchArgument("epsilon", "Probability of a random action, per robot and step.", "0.0"),
    LaunchArgument("relay_observations", "Through the gate, for their faults.", "false", FLAGS),
    NAMESPACE,
    *COMMON,
    LaunchArgument("rviz", "Also start RViz.", "false", FLAGS),
)
OWN_ARGUMENTS = (
    LaunchArgument("robots", "Names of the team, with commas between; empty: as params_file.", ""),
    LaunchArgument("command_type", "package/msg/Type; empty: as params_file, or auto.", ""),
    LaunchArgument("raw_topic", "What controllers publish on; empty: as params_file.", ""),
    LaunchArgument("command_topic", "What robots listen to; empty: as params_file.", ""),
    LaunchArgument("dt_s", "Length of a step of the faults, seconds; empty: as params_file.", ""),
    NAMESPACE,
    *COMMON,
)


def options_from(values: Mapping[str, str]) -> UpOptions:
    """The graph that the launch arguments ask for.

    Raises:
        GraphError: naming a wrong value, or RViz where it is asked for and not installed: before
            anything is started.
        UserError: no such fault scenario.
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
        epsilon=_within("epsilon", values["epsilon"], 0.0, 1.0),
        coach=at_rate(_within("crash_rate", values["crash_rate"], 0.0, 1.0)).crash,
        relay_observations=values["relay_observations"] == "true",
        namespace=values["namespace"],
        **_common(values),
    )


def own_from(values: Mapping[str, str]) -> OwnRobots:
    """Gate and coach that the launch arguments ask for.

    Raises:
        GraphError: naming a wrong value.
        UserError: no such fault scenario.
    """
    names = (name.strip() for name in values["robots"].strip("[] ").split(","))
    return OwnRobots(
        robots=tuple(name for name in names if name),
        command_type=values["command_type"],
        raw_topic=values["raw_topic"],
        command_topic=values["command_topic"],
        dt_s=_within("dt_s", values["dt_s"], 0.001, 60.0) if values["dt_s"] else None,
        namespace=values["namespace"],
        **_common(values),
    )


class _Common(TypedDict):
    params_file: Path | None
    use_sim_time: bool
    log_level: str
    fault_scenario: Path | None


def _common(values: Mapping[str, str]) -> _Common:
    scenario = values["fault_scenario"]
    return {
        "params_file": Path(values["params_file"]) if values["params_file"] else None,
        "use_sim_time": values["use_sim_time"] == "true",
        "log_level": values["log_level"],
        "fault_scenario": find_fault_scenario(scenario) if scenario else None,
    }


def _count(name: str, text: str) -> int:
    if not text.isdecimal():
        raise GraphError(f"launch argument {name}:={text} is not a whole number from 0")
    return int(text)


def _within(name: str, text: str, low: float, high: float) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise GraphError(f"launch argument {name}:={text} is not a number from {low:g} to {high:g}")
    return value
