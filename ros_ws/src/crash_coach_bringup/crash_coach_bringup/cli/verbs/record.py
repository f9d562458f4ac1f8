"""`crash-coach record`: a running team to a rosbag2 recording."""

from __future__ import annotations

import os
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from crash_coach_bringup.cli.output import CliError
from crash_coach_common.executable import command
from sim_pkg.env import make_env

MODULE = "policy_pkg.ros.recorder_node"


class Compression(StrEnum):
    zstd = "zstd"
    lz4 = "lz4"
    none = "none"


class Mode(StrEnum):
    lockstep = "lockstep"
    realtime = "realtime"


def team_parameters(scenario: str | None, robots: list[str]) -> dict[str, Any]:
    """What the recorder is told of the team.

    Raises:
        CliError: neither a scenario nor robots.
        ConfigError: unknown or wrong scenario.
    """
    if scenario is None:
        if not robots:
            raise CliError("whom to record? give --scenario NAME or --robots ROBOT ...")
        return {"robots": robots}
    spec = make_env(scenario, 1).spec
    if robots and tuple(robots) != spec.robots:
        raise CliError(f"--robots {' '.join(robots)}: {scenario} has {' '.join(spec.robots)}")
    return {
        "robots": list(spec.robots),
        "scenario": scenario,
        "stay_actions": list(spec.stay_actions),
        "dt_s": spec.dt_s,
        "episode_limit": spec.episode_limit,
    }


def record(
    out: Annotated[Path, typer.Option(help="Folder of the recording; new, or empty.")],
    scenario: Annotated[
        str | None, typer.Option(help="Scenario name or YAML file that the sim runs.")
    ] = None,
    robots: Annotated[
        list[str] | None, typer.Option(help="ROBOT ...: without a scenario, the team in order.")
    ] = None,
    seed: Annotated[int, typer.Option(help="The sim's, to note it; -1: unknown.", min=-1)] = -1,
    mode: Annotated[Mode, typer.Option(help="The sim's.")] = Mode.lockstep,
    episodes: Annotated[int, typer.Option(help="End after this many; 0: run on.", min=0)] = 0,
    odometry: Annotated[bool, typer.Option("--odometry", help="Also the robots' odom.")] = False,
    split_mb: Annotated[
        int, typer.Option(help="New file after this many megabytes; 0: never.", min=0)
    ] = 1000,
    split_episodes: Annotated[
        int, typer.Option(help="New file after this many episodes; 0: never.", min=0)
    ] = 0,
    compression: Annotated[
        Compression, typer.Option(help="Of the file's chunks.")
    ] = Compression.zstd,
) -> None:
    """Records observations, commands, plans, events and states until Ctrl-C or enough episodes."""
    parameters = {
        "out": str(out.absolute()),
        **team_parameters(scenario, robots or []),
        "seed": seed,
        "mode": mode.value,
        "episodes": episodes,
        "odometry": odometry,
        "split_bytes": split_mb * 1_000_000,
        "split_episodes": split_episodes,
        "compression": compression.value,
    }
    from crash_coach_bringup.ros.graph import ros_arguments

    # In place of this process: signals reach the recorder itself, from its first moment.
    started = command(MODULE)
    os.execv(started[0], [*started, *ros_arguments([], "", parameters)])
