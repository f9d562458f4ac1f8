"""Differences between methods, run by run of the same seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from policy_pkg.report.rows import ALL_MAPS, Row
from policy_pkg.statistics import Estimate, holm, mean_interval, paired_p_value

LEAST_PAIRS = 2  # for an interval


@dataclass(frozen=True)
class PairedDifference:
    """How much higher the success rate of ``method`` is than that of ``against``.

    ``values``: of each seed that both have; over all maps, of each seed the mean of the maps.
    ``interval``: their mean, Student's t, 95 %. ``p``: of a mean of zero, corrected by Holm for
    all comparisons under this condition.
    """

    scenario: str
    condition: str
    method: str
    against: str
    seeds: tuple[int, ...]
    values: tuple[float, ...]
    interval: Estimate
    p: float


def paired_differences(found: Sequence[Row], against: Sequence[str]) -> list[PairedDifference]:
    """All other methods against each of ``against``, per condition: on every map, then over them.

    Each pair once, against the one that is named first. Pairs with fewer than ``LEAST_PAIRS``
    seeds in common are left out; over all maps there is something only where a pair is on each.
    """
    methods = list(dict.fromkeys(row.method for row in found))
    by = {
        (row.scenario, row.condition, row.method): dict(zip(row.seeds, row.success, strict=True))
        for row in found
        if row.scenario != ALL_MAPS
    }
    maps = list(dict.fromkeys(scenario for scenario, _, _ in by))
    chosen = list(dict.fromkeys(against))
    compared = [
        (method, other)
        for place, other in enumerate(chosen)
        for method in methods
        if method not in chosen[: place + 1]
    ]
    out: list[PairedDifference] = []
    for condition in dict.fromkeys(row.condition for row in found):
        family = []
        for method, other in compared:
            pairs = {
                name: _of_each_seed(
                    by.get((name, condition, method), {}), by.get((name, condition, other), {})
                )
                for name in maps
            }
            if len(maps) > 1:
                pairs[ALL_MAPS] = _over_maps(list(pairs.values()))
            for name, of_seeds in pairs.items():
                if len(of_seeds) >= LEAST_PAIRS:
                    seeds, values = tuple(of_seeds), tuple(of_seeds.values())
                    interval = mean_interval(np.array(values))
                    place = (name, condition, method, other)
                    p = paired_p_value(np.array(values))
                    family.append(PairedDifference(*place, seeds, values, interval, p))
        corrected = holm([each.p for each in family])
        out += [replace(each, p=p) for each, p in zip(family, corrected, strict=True)]
    return out


def _of_each_seed(first: dict[int, float], second: dict[int, float]) -> dict[int, float]:
    return {seed: first[seed] - second[seed] for seed in first if seed in second}


def _over_maps(pairs: Sequence[dict[int, float]]) -> dict[int, float]:
    seeds = [seed for seed in pairs[0] if all(seed in each for each in pairs)]
    return {seed: float(np.mean([each[seed] for each in pairs])) for seed in seeds}
