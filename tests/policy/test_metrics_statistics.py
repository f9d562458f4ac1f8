"""Intervals against published and brute-force values; the log file that survives a kill."""

from __future__ import annotations

import json
import resource
from pathlib import Path

import numpy as np
import pytest

from crash_coach_common.contract import UserError
from policy_pkg.statistics import (
    binomial_weights,
    bootstrap_interquartile_mean,
    difference,
    interquartile_mean,
    mean_interval,
    mean_of,
    probability_of_improvement,
    reweighted_success,
    wilson,
)
from policy_pkg.train.metrics import JsonLines, Means


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [  # Newcombe 1998, table I, method 3
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_gives_the_published_intervals(
    successes: int, trials: int, low: float, high: float
) -> None:
    estimate = wilson(successes, trials)
    assert [estimate.low, estimate.high] == pytest.approx([low, high], abs=5e-5)
    mirrored = wilson(trials - successes, trials)
    assert mirrored.low == pytest.approx(1 - estimate.high)


@pytest.mark.parametrize(("successes", "trials"), [(1, 0), (-1, 4), (5, 4)])
def test_wilson_refuses_impossible_counts(successes: int, trials: int) -> None:
    with pytest.raises(ValueError, match="successes of"):
        wilson(successes, trials)


def test_reweighting_is_the_mixture_of_the_strata() -> None:
    rate, n = 0.1, 3
    exact = {0: (128, 128), 1: (64, 128), 2: (0, 128), 3: (0, 128)}
    estimate = reweighted_success(exact, n, rate)
    assert estimate.value == pytest.approx(0.9**3 + 0.5 * 3 * 0.1 * 0.81)
    assert estimate.low < estimate.value < estimate.high
    # Far narrower than 128 draws at that rate.
    drawn = wilson(round(estimate.value * 128), 128)
    assert estimate.high - estimate.low < 0.5 * (drawn.high - drawn.low)
    assert sum(binomial_weights(n, rate)) == pytest.approx(1.0)


def test_an_unmeasured_stratum_widens_only_the_upper_bound() -> None:
    whole = reweighted_success({0: (50, 50), 1: (50, 50), 2: (0, 50)}, 2, 0.3)
    part = reweighted_success({0: (50, 50), 1: (50, 50)}, 2, 0.3)
    assert part.value == pytest.approx(whole.value)
    assert part.high >= part.value + 0.09
    with pytest.raises(ValueError, match=r"crash rate 1\.5"):
        reweighted_success({0: (1, 1)}, 2, 1.5)
    with pytest.raises(ValueError, match=r"\[5\] crashed of 2"):
        reweighted_success({5: (1, 1)}, 2, 0.1)


def test_a_known_stratum_has_no_width() -> None:
    known = reweighted_success({0: (8, 8), 1: (0, 8), 2: (0, 8)}, 2, 0.3, frozenset({0, 1, 2}))
    assert known.low == known.value == known.high == pytest.approx(0.49)


def test_newcombes_interval_of_a_difference() -> None:
    """Example (a) of Newcombe (1998), table II, method 10."""
    found = difference(wilson(56, 70), wilson(48, 80))
    assert [found.value, found.low, found.high] == pytest.approx([0.2, 0.0524, 0.3339], abs=5e-5)


def test_the_mean_of_estimates_is_narrower_than_each() -> None:
    one = wilson(30, 40)
    assert mean_of([one]) == one
    four = mean_of([one] * 4)
    assert four.value == pytest.approx(0.75)
    assert four.high - four.value == pytest.approx((one.high - one.value) / 2)


def test_interquartile_mean() -> None:
    assert interquartile_mean(np.array([100.0, 1, 2, 3, 4, 5, 6, -90])) == pytest.approx(3.5)
    assert interquartile_mean(np.array([0.0, 1, 2, 3, 99])) == pytest.approx(
        (0.75 + 2 + 2.25) / 2.5
    )
    assert interquartile_mean(np.array([7.0])) == 7.0


def test_bootstrap_interval_is_around_the_value_and_repeatable() -> None:
    scores = np.random.default_rng(0).normal(10, 1, size=(3, 8))  # three tasks, eight seeds
    first, second = (
        bootstrap_interquartile_mean(list(scores), np.random.default_rng(1), 500) for _ in range(2)
    )
    assert first == second
    assert first.low < first.value < first.high
    assert first.high - first.low < 2


def test_tasks_may_have_different_numbers_of_seeds() -> None:
    scores = [np.array([0.0, 1.0]), np.array([2.0, 3.0, 4.0, 5.0])]
    found = bootstrap_interquartile_mean(scores, np.random.default_rng(0), 500)
    assert found.value == pytest.approx(interquartile_mean(np.arange(6.0)))


@pytest.mark.parametrize(
    ("seeds", "quantile"),
    [(2, 12.706), (3, 4.303), (4, 3.182), (5, 2.776), (6, 2.571), (31, 2.042)],
)
def test_intervals_of_means_use_the_tabled_quantiles_of_student(
    seeds: int, quantile: float
) -> None:
    scores = np.random.default_rng(seeds).normal(0.5, 0.2, seeds)
    found = mean_interval(scores)
    half = quantile * scores.std(ddof=1) / np.sqrt(seeds)
    assert [found.value, found.low, found.high] == pytest.approx(
        [scores.mean(), scores.mean() - half, scores.mean() + half], abs=2e-4
    )


def test_one_score_has_no_interval_over_seeds() -> None:
    with pytest.raises(ValueError, match="1 score"):
        mean_interval(np.array([0.5]))


def test_probability_of_improvement_counts_pairs() -> None:
    rng = np.random.default_rng(0)
    better, worse = [np.array([0.2, 0.5, 0.9])], [np.array([0.1, 0.5])]
    found = probability_of_improvement(better, worse, rng)
    assert found.value == pytest.approx((2 + 1 + 0.5 + 1) / 6)
    assert 0 <= found.low < found.value < found.high <= 1
    other = probability_of_improvement(worse, better, rng)
    assert other.value == pytest.approx(1 - found.value)


def test_probability_of_improvement_is_the_mean_over_tasks() -> None:
    rng = np.random.default_rng(0)
    wins, loses = np.array([1.0, 1.0, 1.0]), np.array([0.0, 0.0])
    found = probability_of_improvement([wins, loses], [loses, wins], rng)
    assert (found.value, found.low, found.high) == (0.5, 0.5, 0.5)
    with pytest.raises(ValueError, match="of 1 and of 2 tasks"):
        probability_of_improvement([wins], [loses, wins], rng)


def test_means_are_of_what_was_added_and_start_anew() -> None:
    means = Means()
    means.add({"a": 1.0, "b": 5.0})
    means.add({"a": 2.0})
    restored = Means()
    restored.load_state_dict(json.loads(json.dumps(means.state_dict())))
    for either in (means, restored):
        assert either.take(("a", "b", "c")) == {"a": 1.5, "b": 5.0, "c": None}
        assert either.take(("a",)) == {"a": None}


def test_lines_behind_the_checkpoint_are_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    log = JsonLines(path, 0)
    log.append({"step": 1})
    kept = log.sync()
    log.append({"step": 2, "loss": None})
    log.flush()
    log.close()
    resumed = JsonLines(path, kept)
    resumed.append({"step": 3})
    resumed.flush()
    resumed.close()
    assert [json.loads(line)["step"] for line in path.read_text().splitlines()] == [1, 3]
    with pytest.raises(
        UserError, match=r"metrics\.jsonl has 24 bytes, the checkpoint knows of 900"
    ):
        JsonLines(path, 900)


def test_a_refused_line_is_written_later_and_never_in_part(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    log = JsonLines(path, 0)
    log.append({"step": 1})
    log.flush()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20, hard))  # a disk with 20 bytes
    try:
        log.append({"step": 2})
        with pytest.raises(OSError, match="too large"):
            log.flush()
        assert path.read_text() == '{"step": 1}\n'
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    log.append({"step": 3})
    assert log.sync() == path.stat().st_size
    log.close()
    assert [json.loads(line)["step"] for line in path.read_text().splitlines()] == [1, 2, 3]
