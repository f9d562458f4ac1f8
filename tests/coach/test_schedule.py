"""When faults are in force: start steps, durations, hazards, conditions, and the cap."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crash_coach_pkg.plan import CrashPlan, Fault, Trigger, TriggerKind
from crash_coach_pkg.schedule import Schedule, World

STEPS = 30
N = 4
HALF = Trigger(TriggerKind.HAZARD, (0.5,))


def plan(*faults: Fault, cap: int = N, seed: int = 3, episode: int = 2) -> CrashPlan:
    return CrashPlan(episode, 0, seed, 0.0, cap, faults)


def world(step: int, seed: int = 0) -> World:
    """Robots that wander about the unit square, and a return that goes up and down."""
    rng = np.random.default_rng([seed, step])
    return World(rng.random((N, 2), dtype=np.float32), float(rng.normal()))


def follow(crash: CrashPlan, steps: int = STEPS, first: int = 0) -> list[dict[int, int]]:
    """What is in force at each step from ``first`` on."""
    schedule = Schedule(crash, first)
    out = []
    for step in range(first, steps):
        schedule.enter(step, world(step))
        out.append(schedule.in_force)
    return out


def robots(crash: CrashPlan, in_force: dict[int, int]) -> set[int]:
    return {crash.faults[place].robot for place in in_force}


TRIGGERS = st.one_of(
    st.just(Trigger()),
    st.floats(0, 1).map(lambda p: Trigger(TriggerKind.HAZARD, (p,))),
    st.tuples(st.floats(0, 1), st.floats(0, 1), st.floats(0, 1)).map(
        lambda v: Trigger(TriggerKind.NEAR, v)
    ),
    st.floats(-2, 2).map(lambda x: Trigger(TriggerKind.RETURN_ABOVE, (x,))),
)
FAULTS = st.builds(
    Fault,
    robot=st.integers(0, N - 1),
    mode=st.just("mute"),
    start_step=st.integers(0, STEPS),
    duration_steps=st.integers(0, 12),
    trigger=TRIGGERS,
)
SOME_FAULTS = st.lists(FAULTS, min_size=1, max_size=6).map(tuple)
SEEDS = st.integers(0, 2**63 - 1)


@given(st.lists(st.integers(0, STEPS), min_size=2, max_size=2), st.integers(0, 12))
def test_a_start_step_and_a_duration_say_it_all(starts: list[int], duration: int) -> None:
    crash = plan(*(Fault(i, "mute", start, duration) for i, start in enumerate(starts)), cap=0)
    for first in (0, 5):  # also where the plan came in mid-episode
        for step, in_force in enumerate(follow(crash, first=first), first):
            expected = {
                place: start
                for place, start in enumerate(starts)
                if start <= step and (not duration or step < start + duration)
            }
            assert in_force == expected


@settings(max_examples=150)
@given(SOME_FAULTS, SEEDS)
def test_every_stretch_lasts_its_duration_and_begins_no_earlier_than_its_start_step(
    faults: tuple[Fault, ...], seed: int
) -> None:
    crash = plan(*faults, seed=seed)
    history = follow(crash)
    for step, in_force in enumerate(history):
        assert list(in_force) == sorted(in_force)
        for place, since in in_force.items():
            fault = faults[place]
            assert fault.start_step <= since <= step
            assert not fault.duration_steps or step < since + fault.duration_steps
            for later in range(step + 1, STEPS):
                if fault.duration_steps and later >= since + fault.duration_steps:
                    break
                assert history[later][place] == since


@settings(max_examples=150)
@given(SOME_FAULTS, SEEDS, st.integers(0, N))
def test_triggers_never_exceed_the_cap(faults: tuple[Fault, ...], seed: int, cap: int) -> None:
    """Where the start steps alone keep it, nothing breaks it."""
    crash = plan(*faults, seed=seed, cap=cap)
    fixed = tuple(f for f in faults if f.trigger.kind == TriggerKind.STEP)
    alone = [len(robots(plan(*fixed), in_force)) for in_force in follow(plan(*fixed))]
    for step, in_force in enumerate(follow(crash)):
        assert len(robots(crash, in_force)) <= max(cap, max(alone[: step + 1]))
    if max(alone) <= cap:
        assert all(len(robots(crash, in_force)) <= cap for in_force in follow(crash))


def test_a_trigger_waits_for_room_and_leaves_room_for_start_steps() -> None:
    always = Trigger(TriggerKind.HAZARD, (1.0,))
    waits = plan(Fault(0, "mute", 0, 5), Fault(1, "mute", trigger=always), cap=1)
    assert [robots(waits, f) for f in follow(waits, 8)] == [{0}] * 5 + [{1}] * 3
    leaves = plan(Fault(0, "mute", 6), Fault(1, "mute", 0, 2, trigger=always), cap=1)
    history = [robots(leaves, f) for f in follow(leaves, 9)]
    assert history == [{1}] * 6 + [{0}] * 3  # it recovers at 6, before robot 0's time
    endless = plan(Fault(0, "mute", 6), Fault(1, "mute", trigger=always), cap=1)
    assert [robots(endless, f) for f in follow(endless, 8)] == [set()] * 6 + [{0}] * 2


@settings(max_examples=100)
@given(SOME_FAULTS, SEEDS)
def test_conditions_fire_once_at_the_first_step_that_meets_them(
    faults: tuple[Fault, ...], seed: int
) -> None:
    crash = plan(*faults, seed=seed)
    history = follow(crash)
    for place, fault in enumerate(faults):
        kind, values = fault.trigger.kind, fault.trigger.values
        if kind not in (TriggerKind.NEAR, TriggerKind.RETURN_ABOVE):
            continue

        def meets(step: int) -> bool:
            at = world(step)
            if kind == TriggerKind.RETURN_ABOVE:  # noqa: B023
                return at.episode_return > values[0]  # noqa: B023
            offset = at.positions_m[fault.robot].astype(float) - values[:2]  # noqa: B023
            return float(offset @ offset) <= values[2] ** 2  # noqa: B023

        met = [step for step in range(fault.start_step, STEPS) if meets(step)]
        begun = {in_force[place] for in_force in history if place in in_force}
        assert begun == set(met[:1])


@settings(max_examples=100)
@given(SOME_FAULTS, SEEDS, st.sets(st.integers(0, STEPS - 1), min_size=1))
def test_skipping_steps_changes_nothing_without_conditions(
    faults: tuple[Fault, ...], seed: int, entered: set[int]
) -> None:
    crash = plan(*(f for f in faults if not f.trigger.needs_world), seed=seed, cap=2)
    history, schedule = follow(crash), Schedule(crash)
    for step in sorted(entered):
        schedule.enter(step, None)
        assert schedule.in_force == history[step]


@pytest.mark.timeout(20)
def test_an_absurd_step_neither_hangs_nor_hides_what_is_in_force() -> None:
    last = 2**32 - 1
    crash = plan(
        Fault(0, "mute", 3),
        Fault(1, "mute", last - 1, 5),
        Fault(2, "mute", 0, 4),
        Fault(2, "mute", 0, 0, trigger=Trigger(TriggerKind.HAZARD, (0.01,))),
    )
    schedule = Schedule(crash)
    schedule.enter(2, None)
    assert 2 in schedule.in_force
    schedule.enter(last, None)
    assert {0, 1, 3} == set(schedule.in_force)
    assert (schedule.in_force[0], schedule.in_force[1]) == (3, last - 1)


@pytest.mark.parametrize("p", [0.05, 0.4])
def test_a_hazard_strikes_at_its_rate_in_every_step(p: float, fits: Callable[..., bool]) -> None:
    """First strikes are geometric, over episodes and robots; and so are those after a recovery."""
    hazard = Trigger(TriggerKind.HAZARD, (p,))
    firsts, pauses = [], []
    for episode in range(150):
        crash = plan(*(Fault(i, "mute", 0, 3, trigger=hazard) for i in range(N)), episode=episode)
        history = follow(crash)
        for place in range(N):
            begun = sorted({f[place] for f in history if place in f})
            firsts.append(begun[0] if begun else STEPS)
            pauses += [later - begun[0] - 3 for later in begun[1:2] if begun[0] < 10]
    for waits, limit in ((firsts, 6), (pauses, 3)):
        law = [p * (1 - p) ** k for k in range(limit)]
        counts = np.bincount(np.minimum(waits, limit), minlength=limit + 1)
        if waits is firsts:
            assert fits(counts, len(waits) * np.array([*law, (1 - p) ** limit]))
        else:  # the tail is cut off by the episode's end
            assert fits(counts[:limit], counts[:limit].sum() * np.array(law) / sum(law))


def test_hazards_of_robots_entries_seeds_and_episodes_are_unrelated() -> None:
    def struck(**changes: int) -> list[bool]:
        robot = changes.pop("robot", 0)
        before = changes.pop("before", 0)
        faults = [Fault(3, "mute", STEPS * 9)] * before
        faults.append(Fault(robot, "mute", 0, 1, trigger=HALF))
        return [before in f for f in follow(plan(*faults, **changes), 300)]

    base = np.array(struck())
    for change in ({"robot": 1}, {"before": 1}, {"seed": 4}, {"episode": 9}):
        other = np.array(struck(**change))
        assert np.mean(base == other) == pytest.approx(0.5, abs=0.12)
    assert np.mean(base) == pytest.approx(0.5, abs=0.12)
    np.testing.assert_array_equal(base, struck())


def test_a_fault_that_strikes_again_as_it_ends_begins_anew() -> None:
    crash = plan(Fault(0, "mute", 0, 4, trigger=Trigger(TriggerKind.HAZARD, (1.0,))))
    assert [f[0] for f in follow(crash, 10)] == [0] * 4 + [4] * 4 + [8] * 2


def test_steps_come_in_order_and_conditions_need_a_world() -> None:
    schedule = Schedule(plan(Fault(0, "mute")))
    schedule.enter(4, None)
    with pytest.raises(ValueError, match="step 4 comes after step 4"):
        schedule.enter(4, None)
    near = Schedule(plan(Fault(0, "mute", trigger=Trigger(TriggerKind.NEAR, (0, 0, 1)))))
    with pytest.raises(ValueError, match="step 0: the plan has conditions, but there is no world"):
        near.enter(0, None)
    with pytest.raises(ValueError, match="trigger NEAR has 1 values, not 3"):
        Trigger(TriggerKind.NEAR, (1.0,))
