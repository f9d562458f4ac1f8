"""The gate's pure core: plans, leases, duplicates. Laws over random plans: test_gate_laws.py."""

from __future__ import annotations

import numpy as np
import pytest
from gate_cases import (
    LEASE_S,
    MUTE_0,
    RANDOM_1,
    brief,
    command,
    decisions,
    gate,
    plan,
    sight,
)

from crash_coach_common.keyed_random import random_bits
from crash_coach_pkg.effects import WITHHELD
from crash_coach_pkg.faults.batch_faults import random_available
from crash_coach_pkg.gate.messages import Command, Decision
from crash_coach_pkg.gate.plan_book import EventKind
from crash_coach_pkg.plan import NEXT_STEP, Fault


def test_lockstep_holds_until_the_plan_of_the_episode() -> None:
    state = gate()
    assert state.command(command(0, 0, 0), 0.0) == ()
    assert state.command(command(1, 0, 0), 0.0) == ()
    assert brief(state.plan(plan(0, 1), LEASE_S, 0.1)) == [
        (EventKind.ARMED, 0, 0),
        (0, 0, 0, "", 3),
        (1, 0, 0, "", 3),
    ]
    assert state.command(command(0, 1, 0), 0.2) == ()  # the next episode has no plan yet
    assert brief(state.plan(plan(1, 2, MUTE_0), LEASE_S, 0.3)) == [
        (EventKind.ARMED, 1, 0),
        (0, 1, 0, "mute", WITHHELD),
    ]


def test_real_time_never_holds() -> None:
    state = gate(lockstep=False)
    assert brief(state.command(command(0, 5, 9), 0.0)) == [(0, 5, 9, "", 3)]
    assert state.tick(1e9) == ()  # there is no lease before the first plan
    assert brief(state.plan(plan(5, 1, MUTE_0), LEASE_S, 0.0)) == [(EventKind.ARMED, 5, 10)]
    assert brief(state.command(command(0, 5, 10), 0.0)) == [(0, 5, 10, "mute", WITHHELD)]
    assert brief(state.command(command(0, 6, 0), 0.0)) == [(0, 6, 0, "", 3)]


@pytest.mark.parametrize("absurd", [7, 2**32 - 1])
def test_an_episode_after_the_next_makes_nothing_late(absurd: int) -> None:
    state = gate(lockstep=False)
    assert not state.boundary(5, begins=True)
    assert state.command(command(0, absurd, 3), 0.0) == ()
    assert brief(state.command(command(0, 5, 0), 0.0)) == [(0, 5, 0, "", 3)]
    # The next one: the robot may hear of it before this gate does.
    assert brief(state.command(command(1, 6, 0), 0.0)) == [(1, 6, 0, "", 3)]
    assert (state.ahead, state.late) == ([1, 0], [0, 0])
    assert not state.boundary(
        7, begins=False
    )  # two more have begun while nothing came from the robots
    assert brief(state.command(command(0, 7, 0), 0.0)) == [(0, 7, 0, "", 3)]
    assert state.ahead == [1, 0]


@pytest.mark.parametrize("lockstep", [True, False])
@pytest.mark.parametrize("episode", [0, 4])
def test_a_restarted_sim_is_followed(lockstep: bool, episode: int) -> None:
    """Back to an earlier episode, or to the first step of the same one."""
    state = gate(lockstep)
    assert not state.boundary(4, begins=True)
    state.plan(plan(4, 8, MUTE_0), LEASE_S, 0.0)
    for step in range(3):
        state.command(command(0, 4, step), 0.0)
    assert state.command(command(0, 4, 1), 0.0) == ()  # nothing is decided a second time
    assert not state.boundary(4, begins=False)
    assert state.boundary(episode, begins=True)
    if episode != 4:  # the coach follows, and plans for the sim's episode
        state.plan(plan(episode, 9, MUTE_0), LEASE_S, 0.1)
    assert brief(state.command(command(0, episode, 0), 0.2)) == [(0, episode, 0, "mute", WITHHELD)]
    assert brief(state.command(command(1, episode, 0), 0.2)) == [(1, episode, 0, "", 3)]
    assert brief(state.tick(0.1 + LEASE_S)) == [(EventKind.EXPIRED, episode, 1)]


def test_after_a_restart_no_plan_of_another_episode_governs() -> None:
    state = gate(lockstep=False)
    state.boundary(4, begins=True)
    state.plan(plan(5, 8, MUTE_0), LEASE_S, 0.0)
    assert state.boundary(3, begins=True)
    assert brief(state.command(command(0, 3, 0), 0.1)) == [(0, 3, 0, "", 3)]


def test_next_step_is_the_first_step_that_nothing_was_relayed_of() -> None:
    state = gate()
    state.plan(plan(0, 1), LEASE_S, 0.0)
    for step in range(3):
        state.command(command(0, 0, step), 0.0)
        state.command(command(1, 0, step), 0.0)
    state.command(command(1, 0, 3), 0.0)  # robot 0 has not answered step 3 yet
    now = Fault(0, "mute", start_step=NEXT_STEP, duration_steps=2)
    assert brief(state.plan(plan(0, 2, now), LEASE_S, 0.0)) == [(EventKind.ARMED, 0, 4)]
    applied = []
    for step in range(3, 7):
        applied += brief(state.command(command(0, 0, step), 0.0))
    assert [(entry[2], entry[3]) for entry in applied] == [
        (3, ""), (4, "mute"), (5, "mute"), (6, ""),
    ]  # fmt: skip


def test_next_step_of_a_coming_episode_is_0() -> None:
    state = gate()
    state.plan(plan(0, 1), LEASE_S, 0.0)
    state.command(command(0, 0, 8), 0.0)
    now = Fault(1, "mute", start_step=NEXT_STEP)
    assert brief(state.plan(plan(1, 2, now), LEASE_S, 0.0)) == [(EventKind.ARMED, 1, 0)]
    assert brief(state.command(command(1, 0, 8), 0.0)) == [(1, 0, 8, "", 3)]
    assert brief(state.command(command(1, 1, 0), 0.0))[0][3] == "mute"


def test_duplicates_get_the_same_decision_and_the_first_message() -> None:
    state = gate()
    state.plan(plan(0, 1, MUTE_0), LEASE_S, 0.0)
    (muted,) = decisions(state.command(command(0, 0, 0), 0.0))
    (passed,) = state.command(command(1, 0, 0), 0.0)
    assert isinstance(passed, Decision)
    state.plan(plan(0, 2), LEASE_S, 0.0)  # must not change what is decided
    for first in (muted, passed):
        again = Command(first.command.robot, 0, 0, action=1, token="resent")
        (repeated,) = state.command(again, 0.0)
        assert isinstance(repeated, Decision)
        assert repeated.repeated
        assert (repeated.mode, repeated.applied) == (first.mode, first.applied)
        assert repeated.command.token == first.command.token


def test_late_commands_are_dropped_and_counted() -> None:
    state = gate()
    state.plan(plan(3, 1), LEASE_S, 0.0)
    state.command(command(0, 3, 5), 0.0)
    assert state.command(command(0, 3, 4), 0.0) == ()
    assert state.command(command(0, 2, 9), 0.0) == ()
    assert state.command(command(1, 2, 9), 0.0) == ()
    assert sum(state.late) == 3


def test_a_held_command_gives_way_to_a_newer_one() -> None:
    state = gate()
    state.command(command(0, 0, 0), 0.0)
    state.command(command(0, 0, 0), 0.0)  # resent: still the same one
    assert sum(state.late) == 0
    state.command(command(0, 1, 0), 0.0)
    state.command(command(0, 0, 5), 0.0)
    assert sum(state.late) == 2
    assert brief(state.plan(plan(1, 1), LEASE_S, 0.0))[1:] == [(0, 1, 0, "", 3)]


def test_random_waits_for_the_availability_of_its_step_and_is_keyed() -> None:
    state = gate()
    state.plan(plan(2, 1, RANDOM_1), LEASE_S, 0.0)
    assert state.watched_robots == {1}
    available = np.array([True, False, True, True, False])
    assert state.observation(sight(1, 2, 3, available), 0.0) == ()
    # An older step's availability is no good.
    assert decisions(state.command(command(1, 2, 4), 0.0)) == []
    (decision,) = state.observation(sight(1, 2, 4, available), 0.0)
    assert isinstance(decision, Decision)
    expected = random_available(random_bits(7, 2, 4, 1), available[None, :])[0]
    assert (decision.mode, decision.applied) == ("random", expected)
    assert state.watched_robots == {1}


def test_random_in_real_time_draws_from_the_newest_availability_or_withholds() -> None:
    state = gate(lockstep=False)
    state.plan(plan(0, 1, RANDOM_1), LEASE_S, 0.0)
    assert brief(state.command(command(1, 0, 0), 0.0)) == [(1, 0, 0, "random", WITHHELD)]
    state.observation(sight(1, 0, 0, np.array([False, True])), 0.0)
    assert brief(state.command(command(1, 0, 1), 0.0)) == [(1, 0, 1, "random", 1)]


def test_clear_counts_from_the_next_step_and_says_so() -> None:
    state = gate()
    state.plan(plan(0, 1, MUTE_0), LEASE_S, 0.0)
    state.command(command(1, 0, 0), 0.0)  # step 0 has begun under the fault
    assert brief(state.plan(plan(0, 2), LEASE_S, 0.0)) == [
        (EventKind.ARMED, 0, 1),
        (EventKind.CLEARED, 0, 1),
    ]
    assert brief(state.command(command(0, 0, 0), 0.0))[0][3] == "mute"
    assert brief(state.command(command(0, 0, 1), 0.0))[0][3] == ""
    assert brief(state.plan(plan(1, 3), LEASE_S, 0.0)) == [(EventKind.ARMED, 1, 0)]


def test_the_lease_is_kept_by_heartbeats_and_ends_without() -> None:
    state = gate()
    state.plan(plan(0, 1, MUTE_0), LEASE_S, 0.0)
    state.command(command(0, 0, 0), 0.0)
    assert state.plan(plan(0, 1, MUTE_0), LEASE_S, 0.9) == ()
    assert state.tick(1.8) == ()
    assert brief(state.command(command(0, 0, 1), 1.8))[0][3] == "mute"
    assert brief(state.tick(1.9)) == [(EventKind.EXPIRED, 0, 2)]
    assert state.tick(2.0) == ()  # once
    assert brief(state.command(command(0, 0, 2), 2.0))[0][3] == ""
    assert brief(state.command(command(0, 1, 0), 2.0))[0][3] == ""


def test_at_the_end_of_the_lease_everything_held_is_relayed() -> None:
    state = gate()
    state.command(command(0, 0, 0), 5.0)
    assert state.tick(14.9) == ()
    assert brief(state.tick(15.0)) == [(EventKind.EXPIRED, 0, 0), (0, 0, 0, "", 3)]
    state = gate()
    state.plan(plan(0, 1, RANDOM_1), LEASE_S, 0.0)
    state.command(command(1, 0, 0), 0.0)
    assert brief(state.tick(1.0))[1:] == [(1, 0, 0, "", 3)]


@pytest.mark.parametrize("revision", [1, 2, 0])
def test_a_coach_that_comes_back_is_welcome_whatever_its_revision(revision: int) -> None:
    state = gate()
    state.plan(plan(0, 1, MUTE_0), LEASE_S, 0.0)
    state.command(command(0, 0, 0), 0.0)
    state.tick(5.0)
    state.command(command(0, 0, 1), 5.0)
    assert brief(state.plan(plan(0, revision, MUTE_0), LEASE_S, 6.0)) == [(EventKind.ARMED, 0, 2)]
    assert brief(state.command(command(0, 0, 2), 6.0))[0][3] == "mute"


def test_older_revisions_and_plans_of_older_episodes_are_ignored() -> None:
    state = gate()
    state.plan(plan(4, 5), LEASE_S, 0.0)
    state.command(command(0, 4, 0), 0.0)
    assert state.plan(plan(4, 3, MUTE_0), LEASE_S, 0.0) == ()
    assert state.plan(plan(3, 9, MUTE_0), LEASE_S, 0.0) == ()
    assert state.book.ignored == 2
    assert brief(state.command(command(0, 4, 1), 0.0))[0][3] == ""


def test_a_plan_for_a_later_episode_leaves_the_running_one_alone() -> None:
    state = gate()
    state.plan(plan(0, 1, MUTE_0), LEASE_S, 0.0)
    state.command(command(0, 0, 0), 0.0)
    state.plan(plan(1, 2, Fault(1, "mute")), LEASE_S, 0.0)
    assert brief(state.command(command(0, 0, 1), 0.0))[0][3] == "mute"
    assert brief(state.command(command(1, 0, 1), 0.0))[0][3] == ""
    assert brief(state.command(command(1, 1, 0), 0.0))[0][3] == "mute"
