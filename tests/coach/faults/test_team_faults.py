"""TeamFaults: one path for every mode, equal to the batched one, and handed over in mid-episode."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crash_coach_pkg.faults import mode_code
from crash_coach_pkg.faults.action_tools import ActionTools
from crash_coach_pkg.faults.batch_faults import apply_faults
from crash_coach_pkg.faults.team_faults import TeamFaults
from crash_coach_pkg.plan import CrashPlan, Fault, Trigger, TriggerKind

N, STEPS, ACTIONS = 3, 12, 4
ALL = ActionTools(np.ones(ACTIONS, dtype=np.bool_), 0)

STATIC = st.builds(
    Fault,
    robot=st.integers(0, N - 1),
    mode=st.sampled_from(["mute", "stay", "random"]),
    start_step=st.integers(0, STEPS),
    duration_steps=st.integers(0, STEPS),
    entry=st.integers(0, 3),
)


def in_table(plan: CrashPlan, step: int) -> list[Fault | None]:
    """The last fault of the plan that is in force, for each robot."""
    table: list[Fault | None] = [None] * N
    for fault in plan.faults:
        lasts = fault.duration_steps or STEPS * 9
        if fault.start_step <= step < fault.start_step + lasts:
            table[fault.robot] = fault
    return table


@settings(max_examples=100)
@given(
    st.lists(STATIC, max_size=6).map(tuple),
    st.integers(0, 2**63 - 1),
    st.integers(0, 2**32),
)
def test_mute_and_random_are_as_in_batches(faults: tuple[Fault, ...], seed: int, draw: int) -> None:
    plan = CrashPlan(draw % 1000, 0, seed, 0.0, N, faults)
    team: TeamFaults[int] = TeamFaults(plan, N)
    rng = np.random.default_rng(draw)
    for step in range(STEPS):
        available = rng.random((N, ACTIONS)) < 0.5
        available[:, 0] = True
        intent = np.array([rng.choice(np.flatnonzero(row)) for row in available], dtype=np.int32)
        table = in_table(plan, step)
        modes = np.array([mode_code(f.mode if f else "") for f in table], dtype=np.uint8)
        batched = apply_faults(
            intent[None], modes[None], available[None], np.zeros((1, N), np.int32), seed,
            np.array([plan.episode]), np.array([step]),
        )[0]  # fmt: skip
        team.enter(step)
        for robot, fault in enumerate(table):
            effect = team.command(robot, int(intent[robot]), ActionTools(available[robot], -1))
            assert effect.entry == (fault.entry if fault else 0)
            assert mode_code(effect.mode) == modes[robot]
            assert (0 if effect.passed is None else effect.passed) == batched[robot]
        assert team.faulted == {robot for robot, fault in enumerate(table) if fault}


def test_the_last_fault_of_the_plan_counts_for_each_target() -> None:
    faults = (
        Fault(0, "random", entry=1),
        Fault(0, "blind", entry=2),
        Fault(0, "mute", 2, 2, entry=3),
        Fault(0, "noise", 3, entry=4),
    )
    team: TeamFaults[int] = TeamFaults(CrashPlan(0, 0, 0, 0.0, 1, faults), 1)
    found = []
    for step in range(5):
        team.enter(step)
        modes = team.mode(0), team.command_mode(0), team.observation_mode(0)
        found.append((*modes, team.command(0, 1, ALL).entry))
    assert found == [
        ("random", "random", "blind", 1),
        ("random", "random", "blind", 1),
        ("mute", "mute", "blind", 3),
        ("mute", "mute", "noise", 3),
        ("random", "random", "noise", 1),
    ]


def test_a_command_under_an_observation_fault_alone_passes_and_tells_its_mode() -> None:
    fault = Fault(0, "blind", 1, 1, entry=5)
    team: TeamFaults[int] = TeamFaults(CrashPlan(0, 0, 0, 0.0, 1, (fault,)), 1)
    got = []
    for step in range(3):
        team.enter(step)
        got.append(tuple(team.command(0, 2, ALL)))
    assert got == [("", 0, 2), ("blind", 5, 2), ("", 0, 2)]
    assert team.command_mode(0) == ""


def test_changes_are_told_once_with_the_modes_own_name() -> None:
    faults = (Fault(1, "stay", 1, 2, entry=7), Fault(0, "freeze", 2))
    team: TeamFaults[int] = TeamFaults(CrashPlan(0, 0, 0, 0.0, 2, faults), 2)
    told = [
        (c.step, c.began, c.mode, c.fault.robot, c.fault.entry)
        for step in (0, 1, 1, 2, 3, 4)
        for c in team.enter(step)
    ]
    assert told == [
        (1, True, "mute", 1, 7),
        (2, True, "freeze", 0, 0),
        (3, False, "mute", 1, 7),
    ]
    with pytest.raises(ValueError, match="step 2 comes after step 4"):
        team.enter(2)


def test_a_fault_that_strikes_again_at_once_starts_from_new() -> None:
    """A delay's queue is lost with every recovery."""
    always = Trigger(TriggerKind.HAZARD, (1.0,))
    fault = Fault(0, "delay", 0, 4, (("steps", 3),), always)
    team: TeamFaults[int] = TeamFaults(CrashPlan(0, 0, 0, 0.0, 1, (fault,)), 1)
    got, told = [], []
    for step in range(9):
        told += [(c.step, c.began) for c in team.enter(step)]
        got.append(team.command(0, step % ACTIONS, ALL).passed)
    assert got == [None, None, None, 0, None, None, None, 0, None]
    assert told == [(0, True), (4, False), (4, True), (8, False), (8, True)]


def test_a_plan_that_takes_over_knows_what_was_last_wanted_passed_on_and_seen() -> None:
    first: TeamFaults[int] = TeamFaults(CrashPlan(0, 1, 0, 0.0, 1, (Fault(0, "blind", 9),)), 1)
    buffer = np.zeros(2, np.float32)
    for step in range(4):
        first.enter(step)
        buffer[:] = step
        first.observation(0, buffer)
        first.command(0, step, ALL)
    faults = (Fault(0, "freeze", 2), Fault(0, "stale", 4))
    plan = CrashPlan(0, 2, 0, 0.0, 1, faults)
    second = TeamFaults(plan, 1, 4, first.last, first.last_seen, first.wanted)
    second.enter(4)
    buffer[:] = 4
    assert second.observation(0, buffer).tolist() == [3, 3]
    assert second.command(0, 0, ALL).passed == 3


def test_nothing_in_force_gives_the_caller_s_own_array_back() -> None:
    team: TeamFaults[int] = TeamFaults(CrashPlan(0, 0, 0, 0.0, 1), 1)
    team.enter(0)
    features = np.ones(3, np.float32)
    assert team.observation(0, features) is features
    assert tuple(team.command(0, 3, ALL)) == ("", 0, 3)
    assert team.last == [3]


def test_freeze_after_another_fault_holds_what_was_wanted_not_what_that_made_of_it() -> None:
    faults = (Fault(0, "random", 2, 3), Fault(0, "freeze", 5))
    whole: TeamFaults[int] = TeamFaults(CrashPlan(0, 1, 0, 0.0, 1, faults), 1)
    drawn = []
    for step in range(8):
        whole.enter(step)
        passed = whole.command(0, step % ACTIONS, ALL).passed
        if 2 <= step < 5:
            drawn.append(passed)
        if step >= 5:
            assert passed == 4 % ACTIONS
    assert drawn[-1] != 4 % ACTIONS  # otherwise this test would say nothing
    # A plan that takes over in mid-episode knows it too.
    first: TeamFaults[int] = TeamFaults(CrashPlan(0, 1, 0, 0.0, 1, (Fault(0, "random", 0),)), 1)
    for step in range(5):
        first.enter(step)
        first.command(0, step % ACTIONS, ALL)
    frozen = CrashPlan(0, 2, 0, 0.0, 1, (Fault(0, "freeze", 5),))
    second = TeamFaults(frozen, 1, 5, first.last, first.last_seen, first.wanted)
    second.enter(5)
    assert second.command(0, 0, ALL).passed == 4 % ACTIONS
