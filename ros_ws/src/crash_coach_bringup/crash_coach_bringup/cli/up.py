"""`crash-coach up`: a trained team as a running, supervised ROS graph."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from crash_coach_bringup.ros.supervisor import Event


class Mode(StrEnum):
    lockstep = "lockstep"
    realtime = "realtime"


def show(event: Event) -> None:
    """One line per event; a death goes to stderr with the end of the node's log."""
    words = [word for word in (event.kind, event.process, event.text) if word]
    typer.echo(f"up: {': '.join(words)}", err=event.kind == "died")


def up(
    scenario: Annotated[str, typer.Argument(help="Scenario name or YAML file.")],
    policy: Annotated[Path, typer.Option(help="Run directory or checkpoint directory.")],
    mode: Annotated[
        Mode, typer.Option(help="As fast as every robot answers, or by the clock.")
    ] = Mode.lockstep,
    team_process: Annotated[
        bool, typer.Option("--team-process", help="All policies in one process.")
    ] = False,
    episodes: Annotated[int, typer.Option(help="End after this many; 0: run on.", min=0)] = 0,
    seed: Annotated[int, typer.Option(help="Seed of episodes and crashes.", min=0)] = 0,
    relay_observations: Annotated[
        bool,
        typer.Option(
            "--relay-observations",
            help="Observations pass through the gate: blind, stale and noise can be injected.",
        ),
    ] = False,
    logs: Annotated[Path, typer.Option(help="Folder for the nodes' logs.")] = Path("runs/up"),
) -> None:
    """Starts sim, policies, gate and coach, one process each, until Ctrl-C or a node dies."""
    from crash_coach_bringup.ros.graph import UpOptions
    from crash_coach_bringup.ros.up import run_up

    options = UpOptions(
        scenario=scenario,
        checkpoint=policy,
        mode="lockstep" if mode is Mode.lockstep else "realtime",
        layout="team" if team_process else "nodes",
        episodes=episodes,
        seed=seed,
        relay_observations=relay_observations,
        log_dir=logs,
    )
    raise typer.Exit(run_up(options, show))
