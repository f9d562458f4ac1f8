"""Laws of the gate over random plans of every mode and trigger, duplicates, silences and clears."""

from __future__ import annotations

import pytest
from gate_run import LEASE_S, ROBOTS, Run
from hypothesis import given, settings
from hypothesis import strategies as st

from crash_coach_pkg.plan import NEXT_STEP, Fault, Trigger, TriggerKind

triggers = st.one_of(
    st.just(Trigger()),
    st.builds(Trigger, st.just(TriggerKind.HAZARD), st.tuples(st.sampled_from([0.1, 0.5, 1.0]))),
    st.builds(
        Trigger,
        st.just(TriggerKind.NEAR),
        st.tuples(st.sampled_from([0.0, 3.0]), st.just(0.0), st.sampled_from([1.0, 3.5])),
    ),
    st.builds(Trigger, st.just(TriggerKind.RETURN_ABOVE), st.tuples(st.floats(-1, 4))),
)
modes = st.sampled_from(
    [
        ("mute", ()),
        ("random", ()),
        ("freeze", ()),
        ("delay", (("steps", 1.0),)),
        ("delay", (("steps", 2.0),)),
        ("drop", (("probability", 0.5), ("to_bad", 0.3))),
        ("adversarial", ()),
        ("blind", ()),
        ("stale", ()),
        ("noise", (("stddev", 0.5),)),
    ]
)
faults = st.builds(
    lambda robot, mode, start, duration, trigger, entry: Fault(
        robot, mode[0], start, duration, mode[1], trigger, entry
    ),
    st.integers(0, ROBOTS - 1),
    modes,
    st.one_of(st.just(NEXT_STEP), st.integers(0, 6)),
    st.integers(0, 4),
    triggers,
    st.integers(0, 3),
)
operations = st.lists(
    st.one_of(
        st.tuples(st.just("plan"), st.lists(faults, max_size=4)),
        st.tuples(st.just("step"), st.permutations(range(ROBOTS))),
        st.tuples(st.just("together"), st.none()),
        st.tuples(st.just("one"), st.integers(0, ROBOTS - 1)),
        st.tuples(st.just("again"), st.integers(0, ROBOTS - 1)),
        st.tuples(st.just("episode"), st.booleans()),
        st.tuples(st.just("silence"), st.floats(0.0, 0.7)),
        st.tuples(st.just("beat"), st.none()),
        st.tuples(st.just("repeat"), st.none()),  # a new revision that says the same
        st.tuples(st.just("clear"), st.none()),  # a plan without faults
    ),
    max_size=40,
)


def check(lockstep: bool, relays: bool, played: list[tuple[str, object]], by_lease: bool) -> None:
    run = Run(lockstep, relays)
    for operation, argument in played:
        run.play(operation, argument)
    if by_lease:
        # Until nothing is held: before the first plan a lease starts with a held command.
        run.answer(run.steps.index(min(run.steps)))
        before, first = len(run.decided), 0
        run.silence(LEASE_S)
    else:
        # The step under way may still be under the plan that is cleared, by rule.
        before = len(run.decided)
        run.plan(())
        last = run.governs[-1]
        assert last is not None
        first = last.first
        if run.gate.book.next_step != first:  # the plan before had no faults either
            first = 0
    last_step = max(run.steps) + 3
    for _ in range(ROBOTS * (last_step + 1)):
        run.answer(run.steps.index(min(run.steps)))
    assert min(run.steps) >= last_step, "a command was held for ever"
    after = [d for d in list(run.decided.values())[before:] if d.command.step >= first]
    assert len(after) >= 3 * ROBOTS - 1
    assert all(d.mode == "" and d.applied == d.command.action for d in after)
    sights = [s for k, s in run.seen.items() if k[:2] >= (run.episode, last_step - 2)]
    assert all(s.features is None for s in sights)


@settings(max_examples=150)
@given(lockstep=st.booleans(), relays=st.booleans(), played=operations, by_lease=st.booleans())
def test_effects_equal_the_plan_and_a_clear_or_a_lapse_lets_everything_pass(
    lockstep: bool, relays: bool, played: list[tuple[str, object]], by_lease: bool
) -> None:
    check(lockstep, relays, played, by_lease)


def test_steps_without_faults_are_taken_at_once_and_remembered() -> None:
    freeze = Fault(1, "freeze", 4, 2, (), Trigger(), 0)
    run = Run(lockstep=True, relays=False)
    played: list[tuple[str, object]] = [
        ("plan", []), ("step", [*range(ROBOTS)]), *[("together", None)] * 3, ("again", 1),
        ("together", None), ("plan", [freeze]), *[("together", None)] * 3,
    ]  # fmt: skip
    for operation, argument in played:
        run.play(operation, argument)
    assert run.wholes == 4
    assert run.steps == [8] * ROBOTS
    assert run.decided[0, 5, 1].mode == "freeze"
    # The last command before the fault was taken with the rest of its step.
    assert run.decided[0, 5, 1].applied == run.decided[0, 4, 1].applied
    last = run.gate.last(2)
    assert last is not None
    assert last.command.key == (0, 7)


@pytest.mark.soak
@pytest.mark.timeout(1800)
@settings(max_examples=10_000)
@given(lockstep=st.booleans(), relays=st.booleans(), played=operations, by_lease=st.booleans())
def test_ten_thousand_runs(
    lockstep: bool, relays: bool, played: list[tuple[str, object]], by_lease: bool
) -> None:
    check(lockstep, relays, played, by_lease)
