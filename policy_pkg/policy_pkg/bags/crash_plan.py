"""Crash plans in recordings and of a running graph."""

from __future__ import annotations

from typing import Any

from crash_coach_pkg.plan import CrashPlan, Fault, Trigger, TriggerKind
from policy_pkg.bags.assemble import ContradictionError


def read_plan(message: Any, robots: tuple[str, ...]) -> CrashPlan:
    """A CrashPlan message as the coach's type.

    Raises:
        ContradictionError: it faults a robot who is not one of the team.
        ValueError: a trigger that does not exist, or parameters without values.
    """
    return CrashPlan(
        episode=int(message.episode),
        revision=int(message.revision),
        seed=int(message.seed),
        rate=float(message.rate),
        cap=int(message.cap),
        faults=tuple(_fault(fault, robots) for fault in message.faults),
    )


def _fault(message: Any, robots: tuple[str, ...]) -> Fault:
    if message.robot not in robots:
        raise ContradictionError(f"its plan faults {message.robot!r}, who is not one of the team")
    names, values = message.parameter_names, message.parameter_values
    return Fault(
        robot=robots.index(message.robot),
        mode=str(message.mode),
        start_step=int(message.start_step),
        duration_steps=int(message.duration_steps),
        parameters=tuple(zip(names, map(float, values), strict=True)),
        trigger=Trigger(TriggerKind(message.trigger), tuple(map(float, message.trigger_values))),
        entry=int(message.entry),
    )
