"""What the tests of the gate's core share: plans, commands, and what came out in brief."""

from __future__ import annotations

import numpy as np

from crash_coach_common.contract import BoolArray
from crash_coach_pkg.gate.action_gate import GateState
from crash_coach_pkg.gate.messages import Command, Decision, Outputs, Sight
from crash_coach_pkg.gate.plan_book import TEAM, Event
from crash_coach_pkg.plan import CrashPlan, Fault

LEASE_S = 1.0
ALL = np.ones(8, dtype=np.bool_)
MUTE_0 = Fault(robot=0, mode="mute")
RANDOM_1 = Fault(robot=1, mode="random")


def plan(episode: int, revision: int, *faults: Fault) -> CrashPlan:
    return CrashPlan(episode, revision, seed=7, rate=0.1, cap=1, faults=faults)


def gate(lockstep: bool = True) -> GateState:
    return GateState(2, lockstep, first_lease_s=10.0)


def command(robot: int, episode: int, step: int, action: int = 3) -> Command:
    return Command(robot, episode, step, action, token=(robot, episode, step))


def sight(robot: int, episode: int, step: int, available: BoolArray) -> Sight:
    return Sight(robot, episode, step, np.zeros(2, dtype=np.float32), available)


def brief(outputs: Outputs) -> list[tuple[object, ...]]:
    """Decisions as (robot, episode, step, mode, applied), the team's events as (kind, episode,
    step); those of a robot are left out."""
    return [
        (o.kind, o.episode, o.step)
        if isinstance(o, Event)
        else (o.command.robot, *o.command.key, o.mode, o.applied)
        for o in outputs
        if not isinstance(o, Event) or o.robot == TEAM
    ]


def decisions(outputs: Outputs) -> list[Decision]:
    return [o for o in outputs if isinstance(o, Decision)]


def changes(outputs: Outputs) -> list[tuple[object, ...]]:
    """Events of robots as (kind, robot, step, mode)."""
    return [
        (o.kind, o.robot, o.step, o.mode)
        for o in outputs
        if isinstance(o, Event) and o.robot != TEAM
    ]
