"""Expectations, judged on pairs made by hand."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from crash_coach_pkg.coach.expectations import DueFault, Expectation, Finding, Outcome, Pair, Trials


def pair(
    free: tuple[bool, float, int] = (True, 10.0, 20),
    faulted: tuple[bool, float, int] = (True, 8.0, 25),
    crashed: int = 1,
    due: tuple[DueFault, ...] = (),
) -> Pair:
    return Pair(0, Outcome(*free), Outcome(*faulted), crashed, due)


def judge(kind: dict[str, dict[str, float]], *pairs: Pair, entries: int = 1) -> Finding:
    return Expectation.model_validate(kind).kind.judge(Trials(entries, pairs))


LOST = pair(faulted=(False, 2.0, 80))


def test_success_rate_at_its_threshold() -> None:
    found = judge({"success_rate": {"at_least": 0.5}}, pair(), LOST)
    assert found == Finding("passed", 0.5, (1, 2))
    assert judge({"success_rate": {"at_least": 0.51}}, pair(), LOST).status == "failed"


def test_success_rate_of_episodes_with_so_many_crashed() -> None:
    pairs = (pair(crashed=0), pair(crashed=2, faulted=(False, 0, 80)), LOST)
    assert judge({"success_rate": {"at_least": 0.5, "crashed": 0}}, *pairs).counts == (1, 1)
    assert judge({"success_rate": {"at_least": 0.5, "crashed": 2}}, *pairs).counts == (0, 1)
    found = judge({"success_rate": {"at_least": 0.0, "crashed": 3}}, *pairs)
    assert (found.status, found.measured) == ("error", None)
    assert "no episode had 3 crashed robots (there were episodes with 0, 1, 2)" in found.note


def test_return_retained_is_of_the_means() -> None:
    pairs = (pair(), pair(free=(True, 2.0, 5), faulted=(True, 1.0, 5)))
    found = judge({"return_retained": {"at_least": 0.75}}, *pairs)
    assert (found.status, found.measured, found.counts) == ("passed", 9 / 12, None)
    assert judge({"return_retained": {"at_least": 0.76}}, *pairs).status == "failed"


@pytest.mark.parametrize("mean", [0.0, -4.0])
def test_no_share_of_a_return_that_is_not_positive(mean: float) -> None:
    found = judge({"return_retained": {"at_least": 0.0}}, pair(free=(True, mean, 5)))
    assert found.status == "error"
    assert f"{mean:.3g}" in found.note
    assert "return_drop" in found.note
    assert judge({"return_drop": {"at_most": 0.0}}, pair(free=(True, mean, 5))).measured == mean - 8


def test_return_drop_at_its_threshold() -> None:
    assert judge({"return_drop": {"at_most": 2.0}}, pair()) == Finding("passed", 2.0)
    assert judge({"return_drop": {"at_most": 1.9}}, pair()).status == "failed"


def test_recovered_counts_only_what_succeeds_without_faults() -> None:
    hopeless = pair(free=(False, 0, 80))
    late = pair(faulted=(True, 5.0, 26))
    found = judge({"recovered": {"within_steps": 5, "at_least": 1.0}}, pair(), late, LOST, hopeless)
    assert (found.status, found.counts) == ("failed", (1, 3))
    found = judge({"recovered": {"within_steps": 6, "at_least": 0.6}}, pair(), late, LOST)
    assert (found.status, found.counts) == ("passed", (2, 3))
    found = judge({"recovered": {"within_steps": 6, "at_least": 0.0}}, hopeless)
    assert (found.status, found.measured) == ("error", None)


def test_effects_of_every_entry() -> None:
    both = (DueFault(0, "robot_1", True), DueFault(1, "robot_1", False))
    assert judge({"effects": {}}, pair(due=both[:1])) == Finding("passed", 1.0, (1, 1))
    assert judge({"effects": {}}, pair(due=both), entries=2).counts == (1, 2)
    assert judge({"effects": {}}, pair(due=both), entries=2).status == "failed"
    assert judge({"effects": {"at_least": 0.5}}, pair(due=both), entries=2).status == "passed"
    found = judge({"effects": {"at_least": 0.0}}, pair(due=both[:1]), entries=3)
    assert (found.status, found.note) == ("failed", "never due: entry 1, 2 of faults")
    assert judge({"effects": {"at_least": 0.0}}, pair()).status == "failed"
    dead = DueFault(0, "robot_2", took_effect=False, met_dead=True)
    found = judge({"effects": {}}, pair(due=(both[0], dead)))
    assert (found.status, found.counts) == ("failed", (1, 2))
    assert found.note == "1 only met a robot that was out of action already"


@pytest.mark.parametrize(
    ("entry", "names"),
    [
        ({}, "exactly one of: success_rate"),
        ({"effects": {}, "return_drop": {"at_most": 1}}, "given: return_drop, effects"),
        ({"success_rate": {"at_least": 1.1}}, "less than or equal to 1"),
        ({"return_drop": {"at_most": math.nan}}, "finite"),
        ({"recovered": {"at_least": 1}}, "within_steps"),
    ],
)
def test_wrong_expectations_are_refused(entry: dict[str, dict[str, float]], names: str) -> None:
    with pytest.raises(ValidationError, match=names):
        Expectation.model_validate(entry)


outcomes = st.builds(
    Outcome, st.booleans(), st.floats(-100, 100), st.integers(min_value=1, max_value=100)
)
pairs = st.builds(Pair, st.just(0), outcomes, outcomes, st.integers(0, 4), st.just(()))


@given(st.lists(pairs, min_size=1), st.floats(0, 1))
def test_a_lower_demand_never_fails_where_a_higher_one_holds(
    trials: list[Pair], at_least: float
) -> None:
    for kind, more in (("success_rate", {}), ("recovered", {"within_steps": 5})):
        high = judge({kind: {"at_least": at_least, **more}}, *trials)
        low = judge({kind: {"at_least": at_least / 2, **more}}, *trials)
        assert low.measured == high.measured
        assert high.status != "passed" or low.status == "passed"
