"""What methods achieve over their seeds on each map and under each condition."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import numpy.typing as npt

from policy_pkg.report.finished_runs import methods_of
from policy_pkg.report.kept_evaluations import Result, arena
from policy_pkg.report.training import LAST_BLOCKS
from policy_pkg.statistics import (
    Estimate,
    binomial_weights,
    bootstrap_interquartile_mean,
    mean_interval,
    mean_of,
    performance_profile,
    probability_of_improvement,
    reweighted_success,
    wilson,
)

ALL_MAPS = "all maps"
WORST_VICTIM = "worst victim"
Scores = npt.NDArray[np.float64]
THRESHOLDS = np.linspace(0.0, 1.0, 51)
LEAST_SEEDS = 3  # of either method and map, for a probability of improvement


@dataclass(frozen=True)
class Row:
    """A method on a map under a condition.

    ``success``, ``returns``: of each seed; of a row over all maps, success is each map's mean.
    ``interval``: 95 %, of the mean; Student's t over seeds, with one episode per run Wilson's
    over seeds; for a single seed Wilson's over its episodes (of the re-weighted estimate, its
    own); None over all maps, and for a single seed of a single episode: one that went alike each
    time that it was played is one.
    ``iqm``: interquartile mean with stratified bootstrap; None for a single seed.
    ``not_measured``: probability of the numbers of crashed robots that a re-weighted estimate has
    no result for and counts as failures.
    ``alike``: of every seed all episodes are the same one, with nothing left to chance.
    ``crashed``, ``victim``: as of the condition.
    """

    scenario: str
    condition: str
    method: str
    seeds: tuple[int, ...]
    success: tuple[float, ...]
    interval: Estimate | None
    iqm: Estimate | None
    returns: tuple[float, ...] = ()
    not_measured: float = 0.0
    alike: bool = False
    crashed: int | None = None
    victim: str = ""

    @property
    def mean(self) -> float:
        return float(np.mean(self.success))

    @property
    def std(self) -> float | None:
        """The sample's, over seeds; None for a single one and over all maps."""
        if len(self.seeds) < 2 or self.scenario == ALL_MAPS:
            return None
        return float(np.std(self.success, ddof=1))


@dataclass(frozen=True)
class Improvement:
    """How probable it is that a run of one method succeeds more often than one of another."""

    condition: str
    better: str
    worse: str
    scenarios: tuple[str, ...]
    estimate: Estimate


@dataclass(frozen=True)
class Profile:
    """Performance profile: the share of a method's runs with a success rate above each threshold.

    ``share``, ``low``, ``high``: at THRESHOLDS; 95 %.
    """

    condition: str
    method: str
    scenarios: tuple[str, ...]
    share: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]


def rows(results: Sequence[Result], rates: Sequence[float]) -> list[Row]:
    """A row per map, condition and method; then those over all maps, where there are several.

    Behind the conditions that were played come those that follow from them: the rates, the mean
    over exact numbers of crashed robots, and each run's worst victim; and, as a single checkpoint
    says little about a run that goes up and down, the mean of its own last evaluation blocks.

    Args:
        results: of all runs, with the same conditions on the same map; their order is that of
            maps and methods, here and in the figures.
        rates: crash rates to be estimated from the results for exact numbers of crashed robots.
    """
    groups: dict[str, dict[str, list[Result]]] = {}  # map -> method -> results
    maps = list(dict.fromkeys(result.run.scenario for result in results))
    names = methods_of(result.run for result in results)
    for result in sorted(
        results,
        key=lambda r: (maps.index(r.run.scenario), names.index(r.run.method), r.run.seed),
    ):
        methods = groups.setdefault(result.run.scenario, {})
        methods.setdefault(result.run.method, []).append(result)
    found: list[Row] = []
    for methods in groups.values():
        first = next(iter(methods.values()))[0]
        for index in range(len(first.outcomes)):
            found += [_measured(group, index) for group in methods.values()]
        for rate in rates:
            found += [_reweighted(group, rate) for group in methods.values()]
        for summary in (_mean_over_crashed, _worst_victim, _last_blocks):
            found += [row for group in methods.values() if (row := summary(group)) is not None]
    return found + _over_maps(found, tuple(groups))


def _measured(group: Sequence[Result], index: int) -> Row:
    condition = group[0].outcomes[index][0]
    outcomes = [result.outcomes[index][1] for result in group]
    counts = [outcome.counts for outcome in outcomes]
    single = [outcome.estimate for outcome in outcomes]
    row = _row(
        group,
        condition.name,
        single,
        returns=tuple(outcome.return_mean for outcome in outcomes),
        crashed=condition.crashed,
    )
    row = replace(row, alike=all(outcome.alike for outcome in outcomes), victim=condition.victim)
    if any(episodes > 1 for _, episodes in counts):
        return row
    if len(counts) == 1:
        return replace(row, interval=None)  # of one episode
    # Each seed is one success or failure: the counts have no normal distribution.
    return replace(row, interval=wilson(sum(successes for successes, _ in counts), len(counts)))


def _reweighted(group: Sequence[Result], rate: float) -> Row:
    n = len(arena(group[0].run.source)[0])
    single, missing = [], 0.0
    for result in group:
        exact = {
            condition.crashed: outcome
            for condition, outcome in result.outcomes
            if condition.crashed is not None
        }
        counts = {k: (outcome.successes, outcome.episodes) for k, outcome in exact.items()}
        known = frozenset(k for k, outcome in exact.items() if outcome.alike)
        single.append(reweighted_success(counts, n, rate, known))
        weights = binomial_weights(n, rate)
        missing = sum(weight for k, weight in enumerate(weights) if k not in exact)
    return _row(group, f"rate {rate:g}, re-weighted", single, not_measured=missing)


def _mean_over_crashed(group: Sequence[Result]) -> Row | None:
    """Each run's mean over exact numbers of crashed robots; None with less than two numbers."""
    exact = sorted({c.crashed for c, _ in group[0].outcomes if c.crashed is not None})
    if len(exact) < 2:
        return None
    single = [
        mean_of([o.estimate for c, o in result.outcomes if c.crashed is not None])
        for result in group
    ]
    return _row(group, f"mean over k = {', '.join(map(str, exact))}", single)


def _worst_victim(group: Sequence[Result]) -> Row | None:
    """Each run's success with the robot crashed that hurts it most; None without victims."""
    single = []
    for result in group:
        victims = [outcome.estimate for c, outcome in result.outcomes if c.victim]
        if len(victims) < 2:
            return None
        single.append(min(victims, key=lambda estimate: estimate.value))
    return _row(group, WORST_VICTIM, single)


def _last_blocks(group: Sequence[Result]) -> Row | None:
    """Each run's last blocks without crashes; None where one has too few, or acts otherwise."""
    means = [r.training.last_blocks for r in group if not r.run.is_best]
    single = [Estimate(mean, mean, mean) for mean in means if mean is not None]
    if len(single) < len(group):
        return None
    return _row(group, f"crash-free, last {LAST_BLOCKS} blocks", single)


def _row(
    group: Sequence[Result],
    condition: str,
    single: Sequence[Estimate],
    returns: tuple[float, ...] = (),
    not_measured: float = 0.0,
    crashed: int | None = None,
) -> Row:
    """``single``: each seed's success rate."""
    scores = np.array([estimate.value for estimate in single])
    several = len(single) > 1
    interval = mean_interval(scores) if several else single[0]
    known = not several and interval.low == interval.high  # nothing was left to chance
    return Row(
        scenario=group[0].run.scenario,
        condition=condition,
        method=group[0].run.method,
        seeds=tuple(result.run.seed for result in group),
        success=tuple(scores.tolist()),
        interval=None
        if known
        else Estimate(interval.value, max(0.0, interval.low), min(1.0, interval.high)),
        iqm=bootstrap_interquartile_mean([scores], _draws()) if several else None,
        returns=returns,
        not_measured=not_measured,
        crashed=crashed,
    )


def _draws() -> np.random.Generator:
    """Draws of a bootstrap; the same for each, so that a report can be repeated."""
    return np.random.default_rng(0)


def _over_maps(found: Sequence[Row], maps: Sequence[str]) -> list[Row]:
    """Of methods that were evaluated on all maps under a condition, each with several seeds."""
    together: dict[tuple[str, str], list[Row]] = {}
    for row in found:
        together.setdefault((row.condition, row.method), []).append(row)
    out = []
    for (condition, method), same in together.items():
        if len(maps) < 2 or len(same) < len(maps) or min(len(row.seeds) for row in same) < 2:
            continue
        scores = [np.array(row.success) for row in same]
        out.append(
            Row(
                scenario=ALL_MAPS,
                condition=condition,
                method=method,
                seeds=tuple(sorted({seed for row in same for seed in row.seeds})),
                success=tuple(row.mean for row in same),
                interval=None,
                iqm=bootstrap_interquartile_mean(scores, _draws()),
                not_measured=max(row.not_measured for row in same),
                crashed=same[0].crashed,
            )
        )
    return out


def improvements(found: Sequence[Row]) -> list[Improvement]:
    """Every two methods under each measured condition, the one with the higher mean first.

    Over the maps on which both have at least LEAST_SEEDS. Re-weighted rows are left out: they
    follow from measured ones.
    """
    scores: dict[str, dict[str, dict[str, Scores]]] = {}  # condition -> method -> map -> scores
    means: dict[str, list[float]] = {}
    for row in found:
        if row.returns and len(row.seeds) >= LEAST_SEEDS:
            methods = scores.setdefault(row.condition, {})
            methods.setdefault(row.method, {})[row.scenario] = np.array(row.success)
            means.setdefault(row.method, []).append(row.mean)
    ranked = sorted(means, key=lambda method: (-float(np.mean(means[method])), method))
    out = []
    for condition, methods in scores.items():
        for better, worse in combinations([m for m in ranked if m in methods], 2):
            shared = [name for name in methods[better] if name in methods[worse]]
            if shared:
                estimate = probability_of_improvement(
                    [methods[better][name] for name in shared],
                    [methods[worse][name] for name in shared],
                    _draws(),
                )
                out.append(Improvement(condition, better, worse, tuple(shared), estimate))
    return out


def profiles(found: Sequence[Row]) -> list[Profile]:
    """Of every method under each condition that was played, but for single victims.

    Over the maps on which it has at least LEAST_SEEDS; the same rows as for ``improvements``.
    """
    scores: dict[tuple[str, str], dict[str, Scores]] = {}
    for row in found:
        if row.returns and not row.victim and len(row.seeds) >= LEAST_SEEDS:
            scores.setdefault((row.condition, row.method), {})[row.scenario] = np.array(row.success)
    out = []
    for (condition, method), maps in scores.items():
        bounds = performance_profile(list(maps.values()), THRESHOLDS, _draws())
        share, low, high = (tuple(values.tolist()) for values in bounds)
        out.append(Profile(condition, method, tuple(maps), share, low, high))
    return out


def best(found: Iterable[Row]) -> set[tuple[str, str, str]]:
    """(map, condition, method) of the highest means; nothing where all are alike."""
    together: dict[tuple[str, str], list[Row]] = {}
    for row in found:
        together.setdefault((row.scenario, row.condition), []).append(row)
    out = set()
    for same in together.values():
        highest = max(row.mean for row in same)
        first = [row for row in same if row.mean >= highest - 1e-12]
        if len(first) < len(same):
            out |= {(row.scenario, row.condition, row.method) for row in first}
    return out
