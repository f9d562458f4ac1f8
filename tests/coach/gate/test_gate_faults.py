"""The gate's pure core: faults with a memory, conditions, refusals, relayed observations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gate_cases import (
    ALL,
    LEASE_S,
    MUTE_0,
    brief,
    changes,
    command,
    decisions,
    gate,
    plan,
    sight,
)

from crash_coach_pkg.effects import WITHHELD
from crash_coach_pkg.gate.action_gate import GateState
from crash_coach_pkg.gate.messages import Seen
from crash_coach_pkg.gate.plan_book import Event, EventKind
from crash_coach_pkg.plan import NEXT_STEP, Fault, Trigger, TriggerKind
from crash_coach_pkg.schedule import World


def test_stretches_are_told_where_they_begin_and_end() -> None:
    state = gate()
    state.plan(plan(0, 1, Fault(0, "freeze", 1, 2, entry=4)), LEASE_S, 0.0)
    told = []
    for step in range(4):
        state.observation(sight(0, 0, step, ALL), 0.0)
        told += state.command(command(0, 0, step, action=step), 0.0)
        told += state.command(command(1, 0, step), 0.0)
    assert changes(tuple(told)) == [
        (EventKind.ACTIVE, 0, 1, "freeze"),
        (EventKind.CLEARED, 0, 3, "freeze"),
    ]
    mine = [d for d in decisions(tuple(told)) if d.command.robot == 0]
    assert [(d.mode, d.entry, d.applied) for d in mine] == [
        ("", 0, 0), ("freeze", 4, 0), ("freeze", 4, 0), ("", 0, 3),
    ]  # fmt: skip


def test_a_revision_with_the_same_faults_takes_over_without_a_jump() -> None:
    state = gate()
    delay = Fault(0, "delay", NEXT_STEP, 0, (("steps", 2.0),))
    state.plan(plan(0, 1, delay), LEASE_S, 0.0)
    applied = []
    for step in range(6):
        if step == 3:
            again = replace(state.book.in_force, revision=9)
            assert brief(state.plan(again, LEASE_S, 0.0)) == [(EventKind.ARMED, 0, 3)]
        state.observation(sight(0, 0, step, ALL), 0.0)
        outputs = state.command(command(0, 0, step, action=step), 0.0)
        applied += [(d.applied, d.revision) for d in decisions(outputs)]
        assert step == 0 or changes(outputs) == []
    assert applied == [(WITHHELD, 1), (WITHHELD, 1), (0, 1), (1, 9), (2, 9), (3, 9)]


def test_another_plan_ends_what_ran_before() -> None:
    state = gate()
    state.plan(plan(0, 1, MUTE_0), LEASE_S, 0.0)
    state.command(command(0, 0, 0), 0.0)
    state.plan(plan(0, 2, Fault(0, "adversarial", NEXT_STEP)), LEASE_S, 0.0)
    outputs = state.command(command(0, 0, 1)._replace(worst=5), 0.0)
    assert changes(outputs) == [
        (EventKind.CLEARED, 0, 1, "mute"),
        (EventKind.ACTIVE, 0, 1, "adversarial"),
    ]
    assert decisions(outputs)[0].applied == 5


def test_a_policy_that_does_not_tell_its_worst_action_is_counted() -> None:
    state = gate()
    state.plan(plan(0, 1, Fault(0, "adversarial")), LEASE_S, 0.0)
    assert brief(state.command(command(0, 0, 0), 0.0)) == [(0, 0, 0, "adversarial", WITHHELD)]
    assert state.untold == [1, 0]


def test_conditions_hold_commands_until_the_state_of_the_step() -> None:
    state = gate()
    above = Fault(0, "mute", trigger=Trigger(TriggerKind.RETURN_ABOVE, (0.5,)))
    state.plan(plan(0, 1, above), LEASE_S, 0.0)
    assert state.needs_world
    positions_m = np.zeros((2, 2), dtype=np.float32)
    assert state.command(command(0, 0, 0), 0.0) == ()
    assert brief(state.command(command(1, 0, 0), 0.0)) == [(1, 0, 0, "", 3)]  # not concerned
    assert state.world(0, 1, World(positions_m, 9.0), 0.0) == ()  # of another step
    assert brief(state.world(0, 0, World(positions_m, 0.5), 0.0)) == [(0, 0, 0, "", 3)]
    assert brief(state.command(command(0, 0, 1), 0.0)) == [(0, 0, 1, "mute", WITHHELD)]


def test_conditions_in_real_time_look_at_the_newest_state() -> None:
    state = gate(lockstep=False)
    above = Fault(0, "mute", trigger=Trigger(TriggerKind.RETURN_ABOVE, (0.5,)))
    state.plan(plan(0, 1, above), LEASE_S, 0.0)
    assert brief(state.command(command(0, 0, 0), 0.0)) == [(0, 0, 0, "", 3)]  # none is known
    state.world(0, 1, World(np.zeros((2, 2), dtype=np.float32), 1.0), 0.0)
    assert brief(state.command(command(0, 0, 3), 0.0)) == [(0, 0, 3, "mute", WITHHELD)]


def test_robots_need_not_keep_step_in_real_time() -> None:
    state = gate(lockstep=False)
    state.plan(plan(0, 1, Fault(0, "mute", 4, 2), Fault(1, "mute", 4, 2)), LEASE_S, 0.0)
    for step in (3, 4, 5, 6):
        state.command(command(0, 0, step), 0.0)
    modes = [brief(state.command(command(1, 0, step), 0.0))[0][3] for step in (3, 5, 6)]
    assert modes == ["", "mute", ""]


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (Fault(0, "explode"), "unknown crash mode 'explode'"),
        (Fault(0, "bias"), "crash mode bias needs"),
        (Fault(0, "blind"), "start it with relay_observations:=true"),
        (Fault(0, "delay", parameters=(("steps", 0.5),)), "crash mode delay: parameter steps"),
    ],
)
def test_a_plan_that_cannot_be_carried_out_is_refused_and_counts_as_silence(
    fault: Fault, reason: str
) -> None:
    state = gate()
    state.plan(plan(0, 1, MUTE_0), LEASE_S, 0.0)
    (event,) = state.plan(plan(0, 2, fault), LEASE_S, 0.5)
    assert isinstance(event, Event)
    assert (event.kind, event.revision) == (EventKind.REFUSED, 2)
    assert reason in event.detail
    assert state.plan(plan(0, 2, fault), LEASE_S, 0.6) == ()  # its heartbeat
    assert brief(state.command(command(0, 0, 0), 0.9)) == [(0, 0, 0, "mute", WITHHELD)]
    assert brief(state.tick(1.0)) == [(EventKind.EXPIRED, 0, 1)]


def test_relayed_observations_wait_for_the_plan_and_are_changed_once() -> None:
    state = GateState(2, True, 10.0, relay_observations=True)
    look = sight(0, 0, 0, ALL)._replace(features=np.ones(2, dtype=np.float32))
    assert state.observation(look, 0.0) == ()
    state.plan(plan(0, 1, Fault(0, "blind", 0, 1)), LEASE_S, 0.0)
    (again,) = state.observation(look, 0.0)
    assert isinstance(again, Seen)
    assert again.features is not None
    assert not again.features.any()
    # The step has begun: a change counts from the next one on.
    assert state.book.next_step == 1
    (decision,) = decisions(state.command(command(0, 0, 0), 0.0))
    assert (decision.mode, decision.applied, decision.observation) == ("blind", 3, True)
    outputs = state.observation(look._replace(step=1), 0.0)
    assert changes(outputs) == [(EventKind.CLEARED, 0, 1, "blind")]
    assert outputs[-1] == Seen(look._replace(step=1), None)
