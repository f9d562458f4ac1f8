"""A coach that starts in mid-episode, before the lease ran out: no robot-step is treated
differently, whatever the state of the faults that run."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.coach.live_coach import Control, ControlSettings
from crash_coach_pkg.gate.action_gate import GateState
from crash_coach_pkg.gate.messages import Command, Decision, Sight
from crash_coach_pkg.gate.plan_book import Event, EventKind
from crash_coach_pkg.schedule import World
from crash_coach_pkg.team import TeamSpec

TEAM = TeamSpec(("robot_1", "robot_2", "robot_3"), dt_s=0.1)
STEPS = 40
EVERYTHING = np.ones(5, dtype=np.bool_)

FAULTS: list[dict[str, Any]] = [
    {"crash_mode": "mute", "crash_rate": 0.6, "start_step": 4, "duration_steps": 30},
    {"crash_mode": "random", "hazard_rate_hz": 1.5, "duration_steps": 5},
    {"crash_mode": "freeze", "victims": ("robot_2",), "start_step": 3},
    {"crash_mode": "delay", "crash_parameters": {"steps": 6}, "crashed_exactly": 2},
    {
        "crash_mode": "drop",
        "crash_parameters": {"to_bad": 0.2, "to_good": 0.2, "probability": 0.1},
        "victims": ("robot_1", "robot_3"),
    },
    {"crash_mode": "mute", "return_above": 4.5, "duration_steps": 12},
    {
        "crash_mode": "random",
        "near_point_m": (6.0, 0.0),
        "near_radius_m": 1.0,
        "duration_steps": 20,
    },
]


def new_coach(revision: int, fault: dict[str, Any]) -> Control:
    config = CoachConfig(**{"strategy": "fixed", **fault})
    return Control(ControlSettings(seed=3, coach=config), TEAM, revision)


def play(fault: dict[str, Any], takeover: int, config: dict[str, Any]) -> list[Decision | Event]:
    """One episode; before step ``takeover`` another coach, configured by ``config``, takes over."""
    gate = GateState(TEAM.n, lockstep=True, first_lease_s=10.0)
    coach = new_coach(100, fault)
    plan = coach.follow(0)
    assert plan is not None
    out: list[Any] = [*gate.plan(plan, 5.0, 0.0)]
    for step in range(STEPS):
        now_s = 0.1 * step
        if step == takeover:
            second = new_coach(50, config)
            adopted = second.adopt(gate.book.in_force)
            assert adopted is not None
            assert adopted.revision > plan.revision
            assert second.follow(0) is None
            out += gate.plan(adopted, 5.0, now_s)
        positions = np.array([[0.2 * step, r] for r in range(TEAM.n)], dtype=np.float32)
        out += gate.world(0, step, World(positions, 0.25 * step), now_s)
        for robot in range(TEAM.n):
            features = np.zeros(2, dtype=np.float32)
            out += gate.observation(Sight(robot, 0, step, features, EVERYTHING), now_s)
            out += gate.command(Command(robot, 0, step, (step + robot) % 5), now_s)
    return out


def effects(outputs: list[Decision | Event]) -> list[object]:
    """Everything but the revisions, and what the hand-over itself adds: its ARMED."""
    rest: list[Any] = [
        out for out in outputs if isinstance(out, Decision) or out.kind != EventKind.ARMED
    ]
    return [out._replace(revision=0) for out in rest]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: str(fault["crash_mode"]))
@pytest.mark.parametrize("takeover", [1, 8, 23])
def test_no_robot_step_is_treated_differently(fault: dict[str, Any], takeover: int) -> None:
    alone = play(fault, -1, {})
    # The second coach's own parameters, which count from the next episode on, are others.
    handed_over = play(fault, takeover, {"victims": ("robot_1",), "crash_mode": "mute"})
    assert effects(handed_over) == effects(alone)
    decisions = [out for out in alone if isinstance(out, Decision)]
    assert len(decisions) == STEPS * TEAM.n
    assert any(decision.mode for decision in decisions)
    armed = [out.step for out in handed_over if isinstance(out, Event) and out.kind == 0]
    assert armed == [0, takeover]


def test_the_rate_goes_on_after_a_lease_ran_out() -> None:
    gate = GateState(TEAM.n, lockstep=True, first_lease_s=10.0)
    adaptive = ControlSettings(
        coach=CoachConfig(strategy="adaptive", adaptive={"rho": 0.5}), block_episodes=1
    )
    first = Control(adaptive, TEAM, 100)
    for episode in range(2):
        plan = first.follow(episode)
        assert plan is not None
        gate.plan(plan, 1.0, 0.0)
        gate.command(Command(0, episode, 0, 1), 0.0)
        first.finish(True)
    gate.tick(2.0)
    second = Control(adaptive, TEAM, 50)
    adopted = second.adopt(gate.book.in_force)
    assert adopted is not None
    assert (adopted.faults, adopted.episode, adopted.rate) == ((), 1, 0.5)
    assert second.rate == 0.5


def test_what_a_lease_cleared_stays_cleared_until_the_next_episode() -> None:
    gate = GateState(TEAM.n, lockstep=True, first_lease_s=10.0)
    first = new_coach(100, {"crash_rate": 1.0}).follow(0)
    assert first is not None
    gate.plan(first, 1.0, 0.0)
    gate.command(Command(0, 0, 0, 1), 0.1)
    assert any(isinstance(o, Event) and o.kind == EventKind.EXPIRED for o in gate.tick(2.0))
    second = new_coach(50, {"crash_rate": 1.0})
    adopted = second.adopt(gate.book.in_force)
    assert adopted is not None
    assert not adopted.faults
    gate.plan(adopted, 1.0, 2.1)
    (decision,) = gate.command(Command(0, 0, 1, 1), 2.2)
    assert isinstance(decision, Decision)
    assert not decision.mode
    following = second.follow(1)
    assert following is not None
    assert len(following.faults) == TEAM.n
