"""`crash-coach up`: a trained team as a running, supervised ROS graph."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crash_coach_bringup.cli.options import Layout, LayoutOption, Mode, NamespaceOption
from crash_coach_bringup.cli.output import CliError
from crash_coach_bringup.cli.supervised import logs_at, teller
from crash_coach_console.serve import PORT
from policy_pkg.play.conditions import at_rate
from policy_pkg.play.target import HELP

RelayOption = Annotated[
    bool,
    typer.Option(
        "--relay-observations",
        help="Observations pass through the gate: blind, stale and noise can be injected.",
    ),
]
ConsoleOption = Annotated[bool, typer.Option("--console", help="Also serve the team's web page.")]
PortOption = Annotated[
    int, typer.Option(help="Port of the page, with --console.", min=1, max=65535)
]
PaceOption = Annotated[
    float,
    typer.Option(help="Lock-step: most control steps a second; 0: no limit.", min=0, max=1000),
]


def up(
    scenario: Annotated[str, typer.Argument(help="Scenario name or YAML file.")],
    policy: Annotated[Path, typer.Option(help=HELP)],
    mode: Annotated[
        Mode, typer.Option(help="As fast as every robot answers, or by the clock.")
    ] = Mode.lockstep,
    layout: LayoutOption = Layout.nodes,
    episodes: Annotated[int, typer.Option(help="End after this many; 0: run on.", min=0)] = 0,
    seed: Annotated[
        int, typer.Option(help="Seed of episodes, crashes and random actions.", min=0)
    ] = 0,
    pace_hz: PaceOption = 0.0,
    epsilon: Annotated[
        float,
        typer.Option(help="Probability of a random action, per robot and step; 1: a random team."),
    ] = 0.0,
    crash_rate: Annotated[
        float, typer.Option(help="Each robot is mute in an episode with this probability.")
    ] = 0.0,
    relay_observations: RelayOption = False,
    console: ConsoleOption = False,
    port: PortOption = PORT,
    namespace: NamespaceOption = "",
    logs: Annotated[Path, typer.Option(help="Folder for the nodes' logs.")] = Path("runs/up"),
) -> None:
    """Starts sim, policies, gate and coach until the last episode, Ctrl-C, or a node's death.

    Says of every episode who was crashed and how it went, and sums up at the end.
    """
    _check(mode, pace_hz, {"epsilon": epsilon, "crash-rate": crash_rate})
    from crash_coach_bringup.ros.graph import UpOptions
    from crash_coach_bringup.ros.up import run_up

    options = UpOptions(
        scenario=scenario,
        checkpoint=policy,
        mode="lockstep" if mode is Mode.lockstep else "realtime",
        layout=layout.value,
        episodes=episodes,
        seed=seed,
        epsilon=epsilon,
        coach=at_rate(crash_rate).crash,
        sim={"pace_hz": pace_hz} if pace_hz else {},
        relay_observations=relay_observations,
        log_dir=logs,
        namespace=namespace,
    )
    with logs_at(logs):
        raise typer.Exit(run_up(options, teller("up"), port if console else None))


def _check(mode: Mode, pace_hz: float, probabilities: dict[str, float]) -> None:
    """Raises CliError where an option's value has no meaning."""
    for name, value in probabilities.items():
        if not 0 <= value <= 1:
            raise CliError(f"--{name} {value}: a probability from 0 to 1 is needed")
    if pace_hz and mode is Mode.realtime:
        raise CliError(f"--pace-hz {pace_hz:g}: real time goes by the clock; it is for lock-step")
