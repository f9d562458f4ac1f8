"""`crash-coach inject`: crash robots of a running team, or clear every fault."""

from __future__ import annotations

from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from crash_coach_bringup.cli.options import (
    DurationOption,
    ModeOption,
    NamespaceOption,
    ParamOption,
    mode_parameters,
)
from crash_coach_bringup.cli.output import CliError, check_json_target, console, written_first


class ApplyAt(StrEnum):
    next_step = "next_step"
    next_episode = "next_episode"


def inject(
    victims: Annotated[
        list[str] | None, typer.Option(help="ROBOT ...: who crashes, e.g. robot_1.")
    ] = None,
    mode: ModeOption = "mute",
    param: ParamOption = None,
    apply_at: Annotated[
        ApplyAt, typer.Option(help="The very next control step, or the next episode on.")
    ] = ApplyAt.next_step,
    start: Annotated[
        int,
        typer.Option(
            help="First faulted step of each episode, with --apply-at next_episode.", min=0
        ),
    ] = 0,
    duration_steps: DurationOption = 0,
    clear: Annotated[bool, typer.Option("--clear", help="End every fault instead.")] = False,
    timeout_s: Annotated[
        float, typer.Option(help="Longest wait for the coach, seconds.", min=0.1)
    ] = 10.0,
    namespace: NamespaceOption = "",
    json: Annotated[Path | None, typer.Option(help="Also write the result to this file.")] = None,
) -> None:
    """Sets the coach's parameters, as `ros2 param set` would, and waits until they hold."""
    check_json_target(json)
    if clear == bool(victims):
        raise CliError("give either --victims ROBOT ... or --clear")
    if start and apply_at is not ApplyAt.next_episode:
        raise CliError(f"--start {start}: needs --apply-at next_episode; the next step is now")
    parameters = mode_parameters(mode, param or [])
    from crash_coach_bringup.ros import inject as client

    if clear:
        answer = client.clear(timeout_s, namespace=namespace)
        with written_first(json, {"cleared": True, "answer": answer}):
            console.print(answer)
        return
    result = client.inject(
        *(victims or [], mode, apply_at.value, duration_steps, start, timeout_s),
        parameters=parameters,
        namespace=namespace,
    )
    with written_first(json, asdict(result)):
        console.print(str(result))
