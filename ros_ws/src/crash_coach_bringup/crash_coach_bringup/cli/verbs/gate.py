"""`crash-coach gate`: gate and coach in front of robots of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crash_coach_bringup.cli.options import NamespaceOption
from crash_coach_bringup.cli.output import CliError
from crash_coach_bringup.cli.supervised import logs_at, teller

RobotsOption = Annotated[
    list[str] | None, typer.Option(help="NAME ...: the team, as its topics' namespaces are called.")
]
TypeOption = Annotated[
    str,
    typer.Option(
        "--type",
        help="Of the robots' commands, package/msg/Type; auto: the one that is published.",
        show_default="auto",
    ),
]
RawOption = Annotated[
    str,
    typer.Option(
        help="Topic that controllers publish on, within a robot's namespace.",
        show_default="cmd_vel_raw",
    ),
]
CommandOption = Annotated[
    str,
    typer.Option(
        help="Topic that robots listen to, within a robot's namespace.", show_default="cmd_vel"
    ),
]
StepOption = Annotated[
    float | None,
    typer.Option(
        help="Length of a step of the faults, seconds: the period of the commands.",
        min=0.001,
        max=60,
        show_default="0.1",
    ),
]
SimTimeOption = Annotated[
    bool, typer.Option("--use-sim-time", help="Steps are those of /clock, of a simulator.")
]
ScenarioOption = Annotated[
    str | None, typer.Option(help="By name or path: decides who crashes, when and how.")
]
FileOption = Annotated[
    Path | None, typer.Option(help="ROS parameter file for gate and coach; robots may be in it.")
]


def gate(
    robots: RobotsOption = None,
    command_type: TypeOption = "",
    raw: RawOption = "",
    command: CommandOption = "",
    dt_s: StepOption = None,
    use_sim_time: SimTimeOption = False,
    fault_scenario: ScenarioOption = None,
    params_file: FileOption = None,
    namespace: NamespaceOption = "",
    logs: Annotated[Path, typer.Option(help="Folder for the nodes' logs.")] = Path("runs/gate"),
) -> None:
    """Starts gate and coach for a team that publishes its commands itself, until Ctrl-C.

    Commands pass from --raw to --command, untouched until `crash-coach inject` crashes a robot.
    Says of each robot what becomes of its commands, whenever that changes.
    """
    if not robots and params_file is None:
        raise CliError("give --robots NAME ..., or a --params-file that names them")
    from crash_coach_bringup.ros.own_robots import OwnRobots, run_own
    from crash_coach_pkg.coach.fault_scenario import find_fault_scenario

    team = OwnRobots(
        robots=tuple(robots or ()),
        command_type=command_type,
        raw_topic=raw,
        command_topic=command,
        dt_s=dt_s,
        use_sim_time=use_sim_time,
        fault_scenario=find_fault_scenario(fault_scenario) if fault_scenario else None,
        namespace=namespace,
        params_file=params_file,
        log_dir=logs,
    )
    with logs_at(logs):
        raise typer.Exit(run_own(team, teller("gate")))
