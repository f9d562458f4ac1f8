"""Do 95 % intervals hold the truth in 93 to 97 % of 2,000 draws? Where not, how often they do.

docs/algorithms.md states these figures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import numpy.typing as npt
import pytest

from policy_pkg.statistics import (
    Estimate,
    binomial_weights,
    bootstrap_interquartile_mean,
    mean_interval,
    probability_of_improvement,
    reweighted_success,
    wilson,
)

DRAWS = 2000
RESAMPLES = 400  # of each bootstrap: enough for the share that covers, and fast
Floats = npt.NDArray[np.float64]


def coverage(estimates: Iterable[Estimate], truth: float) -> float:
    found = [estimate.low <= truth <= estimate.high for estimate in estimates]
    assert len(found) == DRAWS
    return sum(found) / DRAWS


@pytest.mark.parametrize(
    ("episodes", "rate"),
    [(32, 0.5), (64, 0.3), (128, 0.05), (128, 0.5), (128, 0.9), (256, 0.8), (256, 0.99)],
)
def test_wilson(episodes: int, rate: float) -> None:
    drawn = np.random.default_rng(0).binomial(episodes, rate, DRAWS)
    share = coverage((wilson(int(k), episodes) for k in drawn), rate)
    assert 0.93 <= share <= 0.97


@pytest.mark.parametrize("rate", [0.01, 0.05, 0.1, 0.3])
@pytest.mark.parametrize(
    "truth", [(0.97, 0.6, 0.05), (0.9, 0.5, 0.1, 0.02), (0.95, 0.8, 0.4, 0.2, 0.1, 0.0)]
)
def test_reweighted_estimates(truth: tuple[float, ...], rate: float) -> None:
    n, episodes = len(truth) - 1, 128
    drawn = np.random.default_rng(1).binomial(episodes, truth, (DRAWS, n + 1))
    estimates = (
        reweighted_success({k: (int(s), episodes) for k, s in enumerate(row)}, n, rate)
        for row in drawn
    )
    value = sum(w * p for w, p in zip(binomial_weights(n, rate), truth, strict=True))
    assert 0.93 <= coverage(estimates, value) <= 0.97


def over_seeds(seeds: int, draw: Callable[[np.random.Generator], Floats]) -> list[Floats]:
    rng = np.random.default_rng(seeds)
    return [draw(rng) for _ in range(DRAWS)]


@pytest.mark.parametrize("seeds", [2, 3, 5, 10])
def test_students_interval_over_training_seeds(seeds: int) -> None:
    normal = over_seeds(seeds, lambda rng: rng.normal(0.7, 0.1, seeds))
    assert 0.93 <= coverage(map(mean_interval, normal), 0.7) <= 0.97
    # Success rates of 128 episodes, where runs differ by 0.09 around 0.8.
    rates = over_seeds(seeds, lambda rng: rng.binomial(128, rng.beta(16, 4, seeds)) / 128)
    assert 0.92 <= coverage(map(mean_interval, rates), 0.8) <= 0.97


@pytest.mark.parametrize("seeds", [3, 5])
def test_students_interval_is_too_narrow_where_most_runs_are_perfect_and_some_fail(
    seeds: int,
) -> None:
    rates = over_seeds(seeds, lambda rng: rng.binomial(128, rng.beta(2, 0.5, seeds)) / 128)
    assert 0.84 <= coverage(map(mean_interval, rates), 0.8) < 0.90


@pytest.mark.parametrize(
    ("seeds", "tasks", "least", "most"),
    [
        (3, 1, 0.70, 0.78),  # too narrow by far: three scores cannot tell how they vary
        (5, 1, 0.86, 0.92),
        (5, 4, 0.88, 0.93),
        (30, 1, 0.93, 0.97),
    ],
)
def test_bootstrap_of_the_interquartile_mean(
    seeds: int, tasks: int, least: float, most: float
) -> None:
    rng = np.random.default_rng(2)
    drawn = over_seeds(seeds, lambda own: own.normal(size=(tasks, seeds)))
    estimates = (bootstrap_interquartile_mean(list(each), rng, RESAMPLES) for each in drawn)
    assert least <= coverage(estimates, 0.0) <= most


@pytest.mark.parametrize(
    ("seeds", "least", "most"), [(3, 0.78, 0.85), (5, 0.88, 0.93), (10, 0.93, 0.97)]
)
def test_bootstrap_of_the_probability_of_improvement(seeds: int, least: float, most: float) -> None:
    rng = np.random.default_rng(3)
    drawn = over_seeds(seeds, lambda own: own.normal(size=(2, seeds)))
    estimates = (probability_of_improvement([a], [b], rng, RESAMPLES) for a, b in drawn)
    assert least <= coverage(estimates, 0.5) <= most
