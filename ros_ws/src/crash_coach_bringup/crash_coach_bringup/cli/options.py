"""Options that several verbs have: who crashes and how, and where it is played."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated

import typer

from crash_coach_bringup.cli.output import CliError
from crash_coach_common.contract import UserError
from crash_coach_pkg.faults import check_parameters, fault_mode
from crash_coach_pkg.plan import NEXT_STEP
from policy_pkg.play.conditions import Condition, at_rate, crash_free, exactly, named, within

MODE = "mute"  # unless told otherwise
CrashedOption = Annotated[
    list[int] | None, typer.Option(help="K ...: exactly K robots crash, drawn anew each episode.")
]
ModeOption = Annotated[
    str,
    typer.Option(
        help="What happens to a crashed robot: mute (or stay: it stands still), random, delay or "
        "any other mode of docs/faults.md."
    ),
]
NamespaceOption = Annotated[
    str, typer.Option(help="ROS namespace of the whole graph, so that several share a domain.")
]
ParamOption = Annotated[
    list[str] | None,
    typer.Option(help="NAME=VALUE ...: parameters of the mode, such as steps=3 of delay."),
]


StartOption = Annotated[
    int,
    typer.Option(help="First faulted control step of each episode.", min=0, max=NEXT_STEP - 1),
]
DurationOption = Annotated[
    int,
    typer.Option(help="Control steps; 0: until the episode ends.", min=0, max=NEXT_STEP - 1),
]


MOST_EPISODES = 1_000_000


MOST_PROCESSES = 1024


class Via(StrEnum):
    core = "core"
    ros = "ros"


class Layout(StrEnum):
    nodes = "nodes"
    team = "team"
    single = "single"


ViaOption = Annotated[
    Via,
    typer.Option(help="Played here, or by a real ROS graph in lock-step, with the same results."),
]


LayoutOption = Annotated[
    Layout,
    typer.Option(
        help="With --via ros: a process per node; one for the policies and one for gate and sim; "
        "or one for all."
    ),
]


ProcessesOption = Annotated[
    int,
    typer.Option(
        help="How many processes share the episodes; changes no result.",
        min=1,
        max=MOST_PROCESSES,
    ),
]


EachRobotOption = Annotated[
    bool, typer.Option("--each-robot", help="Each robot alone, in every episode: who hurts most.")
]


class Mode(StrEnum):
    lockstep = "lockstep"
    realtime = "realtime"


def mode_parameters(mode: str, given: list[str]) -> dict[str, float]:
    """The values of ``--param``, checked against ``--mode``.

    Raises:
        CliError: names the option, its value and what would be right.
    """
    try:
        fault_mode(mode)
    except UserError as error:
        raise CliError(f"--mode {mode}: {error}") from None
    parameters: dict[str, float] = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise CliError(f"--param {text}: NAME=VALUE is needed, such as steps=3")
        if name in parameters:
            raise CliError(f"--param {text}: {name} is given more than once")
        try:
            parameters[name] = float(value)
        except ValueError:
            raise CliError(f"--param {text}: {value!r} is not a number") from None
    try:
        check_parameters(mode, parameters)
    except UserError as error:
        raise CliError(f"--param: {error}") from None
    return parameters


def conditions(
    robots: tuple[str, ...],
    rates: list[float],
    crashed: list[int],
    victims: list[str],
    mode: str,
    parameters: Mapping[str, float],
    each_robot: bool | None = None,
) -> list[Condition]:
    """What to evaluate under, in the order rates, counts, victims, each robot; crash-free without.

    Args:
        parameters: of the mode, as ``mode_parameters`` returns them.
        each_robot: also each robot alone. None: where the conditions are no evaluation's;
            otherwise crash-free comes first, which tells what the others cost.

    Raises:
        CliError: names the option, its value and what would be right.
    """
    _check(robots, rates, crashed, victims)
    if not (rates or crashed or victims or each_robot) and (mode != MODE or parameters):
        raise CliError(
            f"--mode {mode}: nobody crashes; say who, such as --crashed 1 or --victims {robots[0]}"
        )
    out = [at_rate(rate, mode, parameters) for rate in rates]
    out += [exactly(count, mode, parameters) for count in crashed]
    if victims:
        out.append(named(victims, mode, parameters))
    if each_robot:
        alone = [named([robot], mode, parameters) for robot in robots]
        out += [condition for condition in alone if condition not in out]
    if each_robot is not None and not any(condition.crashed == 0 for condition in out):
        return [crash_free(), *out]
    return out or [crash_free()]


def timed(found: list[Condition], start: int, duration_steps: int) -> list[Condition]:
    """The same with faults in these steps only.

    Raises:
        CliError: there is nobody whom that could concern.
    """
    for option, steps in (("start", start), ("duration-steps", duration_steps)):
        if steps and not any(condition.crashed != 0 for condition in found):
            raise CliError(f"--{option} {steps}: nobody crashes; say who, such as --crashed 1")
    return [within(condition, start, duration_steps) for condition in found]


def _check(
    robots: tuple[str, ...], rates: list[float], crashed: list[int], victims: list[str]
) -> None:
    """Raises CliError for a wrong value, or one that is there twice."""
    for option, values in (("crash-rate", rates), ("crashed", crashed), ("victims", victims)):
        if twice := [value for value, count in Counter(values).items() if count > 1]:
            raise CliError(f"--{option}: {twice[0]} is given twice")
    for rate in rates:
        if not 0 <= rate <= 1:
            raise CliError(f"--crash-rate {rate}: a probability from 0 to 1 is needed")
    for count in crashed:
        if not 0 <= count <= len(robots):
            raise CliError(f"--crashed {count}: the team has {len(robots)} robots")
    for name in victims:
        if name not in robots:
            raise CliError(f"--victims {name}: unknown robot; one of: {', '.join(robots)}")
