"""`crash-coach train-live`: trains a team on the episodes that it plays over ROS."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from signal import SIGINT
from typing import TYPE_CHECKING, Annotated

import typer

from crash_coach_bringup.cli.jobs import tell_stopped
from crash_coach_bringup.cli.options import Mode
from crash_coach_bringup.cli.output import CliError, console
from crash_coach_bringup.cli.signals import exit_code
from crash_coach_bringup.cli.supervised import teller

if TYPE_CHECKING:
    from crash_coach_bringup.ros.graph import Layout


class Processes(StrEnum):
    single = "single"
    team = "team"
    nodes = "nodes"


LAYOUTS: dict[Processes, Layout] = {
    Processes.single: "single",
    Processes.team: "team",
    Processes.nodes: "nodes",
}


def train_live(
    config: Annotated[
        str, typer.Argument(help="Configuration: a name such as live/buttons, or a YAML file.")
    ],
    out: Annotated[Path, typer.Option(help="Run directory.")],
    override: Annotated[
        list[str] | None,
        typer.Option("--set", help="key=value ...: replaces settings, e.g. n_envs=2 (graphs)"),
    ] = None,
    seed: Annotated[list[int] | None, typer.Option(help="Seed.")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue from the newest checkpoint.")
    ] = False,
    mode: Annotated[
        Mode, typer.Option(help="As fast as every robot answers, or by the clock.")
    ] = Mode.lockstep,
    layout: Annotated[
        Processes,
        typer.Option(help="Processes of a graph: one; one for all policies; one per node."),
    ] = Processes.single,
    logs: Annotated[
        Path | None, typer.Option(help="Folder for the nodes' logs; default: OUT.logs.")
    ] = None,
) -> None:
    """Starts graphs of sim, policies, gate and coach, and a trainer that learns from them."""
    if seed and len(seed) > 1:
        raise CliError(f"--seed {' '.join(map(str, seed))}: one run takes one seed")
    from crash_coach_bringup.ros.live import LiveOptions, run_live

    options = LiveOptions(
        config=config,
        out=out,
        overrides=tuple(override or []),
        seed=seed[0] if seed else None,
        resume=resume,
        mode="lockstep" if mode is Mode.lockstep else "realtime",
        layout=LAYOUTS[layout],
        log_dir=logs,
    )
    code = run_live(options, teller("train-live"), typer.echo)
    if code == exit_code(SIGINT):
        console.print(tell_stopped(out), markup=False, highlight=False, soft_wrap=True)
    raise typer.Exit(code)
