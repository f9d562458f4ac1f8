"""Who hurts most: what each robot costs the team when it alone crashes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from policy_pkg.report.rows import Row
from policy_pkg.statistics import Estimate, difference, mean_interval


@dataclass(frozen=True)
class Cost:
    """How much lower a method's success rate is with ``victim`` crashed than crash-free.

    ``success``: with it crashed. ``values``: the cost of each seed. ``interval``: 95 %, of their
    mean: Student's t; of a single seed Newcombe's, over its episodes, None where these leave
    nothing to chance.
    """

    scenario: str
    method: str
    victim: str
    success: float
    seeds: tuple[int, ...]
    values: tuple[float, ...]
    interval: Estimate | None

    @property
    def mean(self) -> float:
        return float(np.mean(self.values))


def costs(found: Sequence[Row]) -> list[Cost]:
    """Of every victim of every map, those first whose mean cost over the methods is highest.

    Maps, and a victim's methods, keep their order. Without a crash-free row of the same method and
    map there is no cost.
    """
    free = {(row.scenario, row.method): row for row in found if row.crashed == 0}
    out = [
        _cost(row, free[row.scenario, row.method])
        for row in found
        if row.victim and (row.scenario, row.method) in free
    ]
    maps = list(dict.fromkeys(cost.scenario for cost in out))
    of_victim: dict[tuple[str, str], list[float]] = {}
    for cost in out:
        of_victim.setdefault((cost.scenario, cost.victim), []).append(cost.mean)
    # Victims that cost the same stay in the robots' order: sorting is stable.
    return sorted(
        out,
        key=lambda cost: (
            maps.index(cost.scenario),
            -round(float(np.mean(of_victim[cost.scenario, cost.victim])), 9),
        ),
    )


def _cost(row: Row, free: Row) -> Cost:
    values = np.array(free.success) - np.array(row.success)  # of the same seeds, in one order
    interval = None
    if values.size > 1:
        interval = mean_interval(values)
    elif row.interval is not None or free.interval is not None:
        interval = difference(_interval(free), _interval(row))
    return Cost(
        scenario=row.scenario,
        method=row.method,
        victim=row.victim,
        success=row.mean,
        seeds=row.seeds,
        values=tuple(values.tolist()),
        interval=interval,
    )


def _interval(row: Row) -> Estimate:
    return row.interval or Estimate(row.mean, row.mean, row.mean)
