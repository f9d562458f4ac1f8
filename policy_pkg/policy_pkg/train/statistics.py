"""Intervals for success rates, and averages over seeds that resist outliers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class Estimate:
    """A value with its confidence interval."""

    value: float
    low: float
    high: float


def wilson(successes: int, trials: int, confidence: float = 0.95) -> Estimate:
    """Wilson's score interval of a success rate (Wilson 1927); sound also at 0 and 1.

    Raises:
        ValueError: no trial, or not 0 <= successes <= trials.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"{successes} successes of {trials} trials")
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    p = successes / trials
    scale = 1 / (1 + z * z / trials)
    centre = scale * (p + z * z / (2 * trials))
    half = scale * z * math.sqrt(p * (1 - p) / trials + z * z / (4 * trials * trials))
    # The bounds touch p at 0 and 1; rounding must not put p outside.
    return Estimate(p, min(p, max(0.0, centre - half)), max(p, min(1.0, centre + half)))


def binomial_weights(n: int, rate: float) -> list[float]:
    """P(k of n crashed) for k = 0..n, each robot on its own at ``rate``."""
    return [math.comb(n, k) * rate**k * (1 - rate) ** (n - k) for k in range(n + 1)]


def reweighted_success(
    exact: Mapping[int, tuple[int, int]], n: int, rate: float, confidence: float = 0.95
) -> Estimate:
    """Success rate at a crash rate from results with exactly k crashed robots.

    The strata's Wilson bounds are combined by MOVER (Zou and Donner 2008), which stays sound
    where every episode of a stratum has the same outcome. Counts k that were not measured enter
    the value as failures; the upper bound allows them to be successes.

    Args:
        exact: k -> (successes, episodes).
        n: robots of the team.
        rate: crash probability of each robot.

    Raises:
        ValueError: a k outside 0..n, nothing measured, or a rate outside [0, 1].
    """
    if not 0 <= rate <= 1:
        raise ValueError(f"crash rate {rate} is not in [0, 1]")
    outside = [k for k in exact if not 0 <= k <= n]
    if outside or not exact:
        raise ValueError(f"exact results for {sorted(exact)} crashed of {n} robots")
    weights = binomial_weights(n, rate)
    value = below = above = 0.0
    for k, (successes, episodes) in exact.items():
        stratum = wilson(successes, episodes, confidence)
        value += weights[k] * stratum.value
        below += (weights[k] * (stratum.value - stratum.low)) ** 2
        above += (weights[k] * (stratum.high - stratum.value)) ** 2
    unmeasured = sum(weight for k, weight in enumerate(weights) if k not in exact)
    high = value + math.sqrt(above) + unmeasured
    return Estimate(value, max(0.0, value - math.sqrt(below)), min(1.0, high))


def interquartile_mean(scores: npt.NDArray[np.float64]) -> float:
    """Mean of the middle half of all scores, whole and fractional (Agarwal et al. 2021).

    A quarter of the mass is cut at each end, of a score in part where it does not divide.
    """
    ordered = np.sort(scores, axis=None)
    count = ordered.size
    if count == 0:
        raise ValueError("no score to average")
    edges = np.arange(count + 1) / count
    share = np.minimum(edges[1:], 0.75) - np.maximum(edges[:-1], 0.25)
    return float(np.clip(share, 0.0, None) @ ordered / 0.5)


def bootstrap_interquartile_mean(
    scores: npt.NDArray[np.float64],
    rng: np.random.Generator,
    resamples: int = 2000,
    confidence: float = 0.95,
) -> Estimate:
    """Interquartile mean with a stratified percentile bootstrap interval.

    Args:
        scores: (seeds, tasks); seeds are drawn with replacement within each task.
    """
    seeds, tasks = scores.shape
    draws = rng.integers(seeds, size=(resamples, seeds, tasks))
    means = [interquartile_mean(np.take_along_axis(scores, draw, axis=0)) for draw in draws]
    tail = (1 - confidence) / 2
    low, high = np.quantile(means, [tail, 1 - tail])
    return Estimate(interquartile_mean(scores), float(low), float(high))
