"""Differences between methods, paired by seed; which one is the best."""

from __future__ import annotations

import pytest

from policy_pkg.report.paired import PairedDifference, paired_differences
from policy_pkg.report.rows import ALL_MAPS, Row, best


def row(
    scenario: str, method: str, success: dict[int, float], condition: str = "crash-free"
) -> Row:
    seeds, scores = tuple(success), tuple(success.values())
    return Row(scenario, condition, method, seeds, scores, interval=None, iqm=None)


def places(found: list[PairedDifference]) -> list[tuple[str, str, str, tuple[int, ...]]]:
    return [(each.scenario, each.method, each.against, each.seeds) for each in found]


def test_only_seeds_that_both_have_are_compared() -> None:
    rows = [
        row("3m", "qmix", {0: 0.5, 1: 0.75, 2: 0.1}),
        row("3m", "fix", {2: 0.4, 0: 0.6, 1: 0.65, 3: 1.0}),
        row("3m", "alone", {7: 1.0, 8: 1.0}),
        row("3m", "single", {0: 1.0}),
    ]
    (found,) = paired_differences(rows, ["qmix"])
    assert places([found]) == [("3m", "fix", "qmix", (2, 0, 1))]
    assert found.values == pytest.approx((0.3, 0.1, -0.1))
    # Mean 0.1, standard deviation 0.2, t(2) = 4.3027.
    half = 4.302653 * 0.2 / 3**0.5
    assert found.interval.value == pytest.approx(0.1)
    assert (found.interval.low, found.interval.high) == pytest.approx((0.1 - half, 0.1 + half))
    assert paired_differences(rows, []) == []


def test_over_all_maps_a_seed_is_the_mean_of_its_maps() -> None:
    rows = [
        row("3m", "qmix", {0: 0.5, 1: 0.5, 2: 0.5}),
        row("3m", "fix", {0: 0.6, 1: 0.7, 2: 0.8}),
        row("3m", "here", {0: 0.5, 1: 0.5}),
        row("8m", "qmix", {0: 0.2, 1: 0.2}),
        row("8m", "fix", {0: 0.1, 1: 0.4}),
        # As `rows` gives them: means of maps, not of seeds.
        row(ALL_MAPS, "qmix", {0: 0.5, 1: 0.2}),
        row(ALL_MAPS, "fix", {0: 0.7, 1: 0.25}),
    ]
    found = paired_differences(rows, ["qmix", "qmix", "fix"])
    assert places(found) == [
        ("3m", "fix", "qmix", (0, 1, 2)),
        ("8m", "fix", "qmix", (0, 1)),
        (ALL_MAPS, "fix", "qmix", (0, 1)),
        ("3m", "here", "qmix", (0, 1)),
        ("3m", "here", "fix", (0, 1)),
    ]
    assert found[2].values == pytest.approx((0.0, 0.2))


def test_conditions_are_kept_apart() -> None:
    rows = [
        row("3m", method, {0: score, 1: score}, condition)
        for condition, scores in (("crash-free", (0.9, 0.8)), ("1 crashed", (0.2, 0.7)))
        for method, score in zip(("qmix", "fix"), scores, strict=True)
    ]
    found = paired_differences(rows, ["qmix"])
    assert [each.condition for each in found] == ["crash-free", "1 crashed"]
    assert [each.interval.value for each in found] == pytest.approx([-0.1, 0.5])


def test_the_best_are_named_where_there_is_a_difference() -> None:
    rows = [
        row("3m", "qmix", {0: 0.5, 1: 0.7}),
        row("3m", "fix", {0: 0.7, 1: 0.5}),
        row("3m", "poor", {0: 0.5, 1: 0.5}),
        row("8m", "qmix", {0: 0.0, 1: 0.0}),
        row("8m", "fix", {0: 0.0, 1: 0.0}),
        row("2m", "qmix", {0: 1.0, 1: 1.0}),
    ]
    assert best(rows) == {("3m", "crash-free", "qmix"), ("3m", "crash-free", "fix")}
