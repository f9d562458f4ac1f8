"""Intervals for success rates, and averages over seeds that resist outliers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
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
    exact: Mapping[int, tuple[int, int]],
    n: int,
    rate: float,
    known: frozenset[int] = frozenset(),
    confidence: float = 0.95,
) -> Estimate:
    """Success rate at a crash rate from results with exactly k crashed robots.

    The strata's Wilson bounds are combined by MOVER (Zou and Donner 2008), which stays sound
    where every episode of a stratum has the same outcome. Counts k that were not measured enter
    the value as failures; the upper bound allows them to be successes.

    Args:
        exact: k -> (successes, episodes).
        n: robots of the team.
        rate: crash probability of each robot.
        known: counts k whose rate is exact, because nothing in their episodes is left to chance.

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
        if k in known:
            continue
        below += (weights[k] * (stratum.value - stratum.low)) ** 2
        above += (weights[k] * (stratum.high - stratum.value)) ** 2
    unmeasured = sum(weight for k, weight in enumerate(weights) if k not in exact)
    high = value + math.sqrt(above) + unmeasured
    return Estimate(value, max(0.0, value - math.sqrt(below)), min(1.0, high))


def mean_of(estimates: Sequence[Estimate]) -> Estimate:
    """The mean of independent estimates; their intervals are combined by MOVER, as above."""
    n = len(estimates)
    value = sum(each.value for each in estimates) / n
    below = math.sqrt(sum((each.value - each.low) ** 2 for each in estimates)) / n
    above = math.sqrt(sum((each.high - each.value) ** 2 for each in estimates)) / n
    return Estimate(value, value - below, value + above)


def difference(first: Estimate, second: Estimate) -> Estimate:
    """``first`` - ``second``: Newcombe's interval of a difference of two rates (1998, method 10),
    where both have Wilson's. Rates of the same episodes (paired) go together: it is then too wide.
    """
    value = first.value - second.value
    below = math.hypot(first.value - first.low, second.high - second.value)
    above = math.hypot(first.high - first.value, second.value - second.low)
    return Estimate(value, value - below, value + above)


def mean_interval(scores: npt.NDArray[np.float64], confidence: float = 0.95) -> Estimate:
    """Mean over seeds with Student's t interval, the one that holds with three to five seeds.

    Exact for normal scores. Equal scores give an interval without width, which is no certainty.

    Args:
        scores: (seeds,), at least two.

    Raises:
        ValueError: fewer.
    """
    if scores.size < 2:
        raise ValueError(f"{scores.size} score: an interval over seeds needs two")
    mean = float(scores.mean())
    error = float(scores.std(ddof=1)) / math.sqrt(scores.size)
    half = _student_quantile(scores.size - 1, confidence) * error
    return Estimate(mean, mean - half, mean + half)


@cache
def _student_quantile(freedom: int, confidence: float) -> float:
    """t with P(|T| < t) = ``confidence``, by bisection."""
    low, high = 0.0, 1.0
    while _student_within(high, freedom) < confidence:
        high *= 2
    for _ in range(60):
        middle = (low + high) / 2
        if _student_within(middle, freedom) < confidence:
            low = middle
        else:
            high = middle
    return high


def _student_within(t: float, freedom: int) -> float:
    """P(|T| < t) of Student's t (Abramowitz and Stegun 26.7.3 and 26.7.4)."""
    angle = math.atan(t / math.sqrt(freedom))
    first = 1 + freedom % 2  # the power of the cosine that the series begins after
    term = total = math.cos(angle) if freedom % 2 else 1.0
    for k in range(first, freedom - 2, 2):
        term *= k / (k + 1) * math.cos(angle) ** 2
        total += term
    if freedom % 2 == 0:
        return math.sin(angle) * total
    return 2 / math.pi * (angle + (math.sin(angle) * total if freedom > 1 else 0.0))


def paired_p_value(differences: npt.NDArray[np.float64]) -> float:
    """Two-sided p that the mean difference over seeds is zero: Student's t.

    Where all are equal t knows no spread: then the share of sign flips that give a mean as large,
    2^(1 - seeds), or 1 where all are zero.

    Args:
        differences: (seeds,), at least two.

    Raises:
        ValueError: fewer.
    """
    count = differences.size
    if count < 2:
        raise ValueError(f"{count} difference: a test over seeds needs two")
    error = float(differences.std(ddof=1)) / math.sqrt(count)
    mean = abs(float(differences.mean()))
    if error <= 1e-12:
        return 1.0 if mean <= 1e-12 else 2.0 ** (1 - count)
    return max(0.0, 1.0 - _student_within(mean / error, count - 1))


def holm(p_values: Sequence[float]) -> list[float]:
    """The p values of one family of tests, adjusted for how many they are (Holm 1979)."""
    count = len(p_values)
    adjusted, highest = [1.0] * count, 0.0
    for rank, index in enumerate(sorted(range(count), key=lambda i: p_values[i])):
        highest = max(highest, min(1.0, (count - rank) * p_values[index]))
        adjusted[index] = highest
    return adjusted


def performance_profile(
    scores: Sequence[npt.NDArray[np.float64]],
    thresholds: npt.NDArray[np.float64],
    rng: np.random.Generator,
    resamples: int = 2000,
    confidence: float = 0.95,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Share of runs that score more than each threshold (Agarwal et al. 2021), a mean over tasks.

    Args:
        scores: of each task (seeds,).
        thresholds: (T,).

    Returns:
        (T,) the share and the bounds of a stratified percentile bootstrap, at each threshold.
    """
    value = np.zeros(len(thresholds))
    drawn = np.zeros((resamples, len(thresholds)))
    for task in scores:
        value += np.mean(task[:, None] > thresholds, axis=0) / len(scores)
        chosen = _resample(task, rng, resamples)
        for index, threshold in enumerate(thresholds):
            drawn[:, index] += np.mean(chosen > threshold, axis=1) / len(scores)
    tail = (1 - confidence) / 2
    low, high = np.quantile(drawn, [tail, 1 - tail], axis=0)
    return value, low, high


def interquartile_mean(scores: npt.NDArray[np.float64]) -> float:
    """Mean of the middle half of all scores, whole and fractional (Agarwal et al. 2021).

    A quarter of the mass is cut at each end, of a score in part where it does not divide.
    """
    if scores.size == 0:
        raise ValueError("no score to average")
    return float(np.sort(scores, axis=None) @ _middle_half(scores.size))


def _middle_half(count: int) -> npt.NDArray[np.float64]:
    """(count,) weight of each score, by rank, in the interquartile mean."""
    edges = np.arange(count + 1) / count
    share = np.minimum(edges[1:], 0.75) - np.maximum(edges[:-1], 0.25)
    return np.clip(share, 0.0, None) / 0.5


def bootstrap_interquartile_mean(
    scores: Sequence[npt.NDArray[np.float64]],
    rng: np.random.Generator,
    resamples: int = 2000,
    confidence: float = 0.95,
) -> Estimate:
    """Interquartile mean with a stratified percentile bootstrap interval.

    With fewer than about thirty scores in all the interval is too narrow; docs/algorithms.md says
    by how much.

    Args:
        scores: of each task (seeds,); seeds are drawn with replacement within each task.
    """
    drawn = np.concatenate([_resample(task, rng, resamples) for task in scores], axis=1)
    means = np.sort(drawn, axis=1) @ _middle_half(drawn.shape[1])
    return _percentiles(interquartile_mean(np.concatenate(scores)), means, confidence)


def probability_of_improvement(
    better: Sequence[npt.NDArray[np.float64]],
    worse: Sequence[npt.NDArray[np.float64]],
    rng: np.random.Generator,
    resamples: int = 2000,
    confidence: float = 0.95,
) -> Estimate:
    """How probable it is that a run of one method beats one of another (Agarwal et al. 2021).

    Of each task the share of pairs of runs in which the first scores more (Mann and Whitney's U
    divided by its largest value; equal scores count half); the mean over tasks. The interval is a
    stratified percentile bootstrap over both methods' seeds.

    Args:
        better: of each task (seeds,), the first method's scores.
        worse: of the same tasks, the second method's; the numbers of seeds may differ.

    Raises:
        ValueError: other tasks for one than for the other, or none.
    """
    if not better or len(better) != len(worse):
        raise ValueError(f"scores of {len(better)} and of {len(worse)} tasks")
    value = 0.0
    drawn = np.zeros(resamples)
    for first, second in zip(better, worse, strict=True):
        value += float(_wins(first[None], second[None])[0]) / len(better)
        pair = _resample(first, rng, resamples), _resample(second, rng, resamples)
        drawn += _wins(*pair) / len(better)
    return _percentiles(value, drawn, confidence)


def _wins(
    first: npt.NDArray[np.float64], second: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """(R,) share of pairs with a larger first score, equal ones half; of (R, a) and (R, b)."""
    share: npt.NDArray[np.float64] = np.mean(
        0.5 + 0.5 * np.sign(first[:, :, None] - second[:, None, :]), axis=(1, 2)
    )
    return share


def _resample(
    scores: npt.NDArray[np.float64], rng: np.random.Generator, resamples: int
) -> npt.NDArray[np.float64]:
    """(resamples, seeds) draws of ``scores`` with replacement."""
    return scores[rng.integers(len(scores), size=(resamples, len(scores)))]


def _percentiles(value: float, drawn: npt.NDArray[np.float64], confidence: float) -> Estimate:
    tail = (1 - confidence) / 2
    low, high = np.quantile(drawn, [tail, 1 - tail])
    return Estimate(value, float(low), float(high))
