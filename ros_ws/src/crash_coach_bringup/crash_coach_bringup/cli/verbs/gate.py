"""`crash-coach gate`: gate and coach in front of robots of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crash_coach_bringup.cli.options import NamespaceOption
from crash_coach_bringup.cli.supervised import logs_at, teller


def gate(
    robots: Annotated[
        list[str], typer.Option(help="NAME ...: the team, as its topics' namespaces are called.")
    ],
    command_type: Annotated[
        str,
        typer.Option(
            "--type",
            help="Of the robots' commands, package/msg/Type; auto: the one that is published.",
        ),
    ] = "auto",
    raw: Annotated[
        str, typer.Option(help="Topic that controllers publish on, within a robot's namespace.")
    ] = "cmd_vel_raw",
    command: Annotated[
        str, typer.Option(help="Topic that robots listen to, within a robot's namespace.")
    ] = "cmd_vel",
    dt_s: Annotated[
        float,
        typer.Option(
            help="Length of a step of the faults, seconds: the period of the commands.",
            min=0.001,
            max=60,
        ),
    ] = 0.1,
    use_sim_time: Annotated[
        bool, typer.Option("--use-sim-time", help="Steps are those of /clock, of a simulator.")
    ] = False,
    namespace: NamespaceOption = "",
    logs: Annotated[Path, typer.Option(help="Folder for the nodes' logs.")] = Path("runs/gate"),
) -> None:
    """Starts gate and coach for a team that publishes its commands itself, until Ctrl-C.

    Commands pass from --raw to --command, untouched until `crash-coach inject` crashes a robot.
    Says of each robot what becomes of its commands, whenever that changes.
    """
    from crash_coach_bringup.ros.own_robots import OwnRobots, run_own

    team = OwnRobots(
        robots=tuple(robots),
        command_type=command_type,
        raw_topic=raw,
        command_topic=command,
        dt_s=dt_s,
        use_sim_time=use_sim_time,
        namespace=namespace,
        log_dir=logs,
    )
    with logs_at(logs):
        raise typer.Exit(run_own(team, teller("gate")))
