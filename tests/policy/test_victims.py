"""Who hurts most: costs against crash-free, paired by seed, sorted."""

from __future__ import annotations

import pytest

from policy_pkg.report.rows import Row
from policy_pkg.report.victims import costs
from policy_pkg.statistics import Estimate, difference


def row(method: str, victim: str, *success: float, interval: Estimate | None = None) -> Row:
    """``victim`` '': crash-free."""
    return Row(
        scenario="3m",
        condition=f"{victim} mute" if victim else "crash-free",
        method=method,
        seeds=tuple(range(len(success))),
        success=success,
        interval=interval,
        iqm=None,
        crashed=None if victim else 0,
        victim=victim,
    )


def test_who_costs_most_on_average_comes_first() -> None:
    found = costs(
        [
            *(row("qmix", "", 1.0, 0.8), row("fix", "", 0.9, 0.9)),
            *(row("qmix", "a", 1.0, 0.6), row("fix", "a", 0.9, 0.9)),
            *(row("qmix", "b", 0.5, 0.5), row("fix", "b", 0.3, 0.2)),
            row("alone", "a", 0.1, 0.1),  # without a crash-free row: nothing to be held against
        ]
    )
    places = [(cost.victim, cost.method) for cost in found]
    assert places == [("b", "qmix"), ("b", "fix"), ("a", "qmix"), ("a", "fix")]
    assert found[0].values == pytest.approx((0.5, 0.3))
    assert (found[0].mean, found[0].success) == pytest.approx((0.4, 0.5))
    # Student's t with one degree of freedom: 12.706 times 0.1414 / sqrt(2).
    assert found[0].interval is not None
    assert found[0].interval.high - 0.4 == pytest.approx(12.7062 * 0.1, abs=1e-4)


def test_a_single_seed_has_newcombes_interval_and_a_known_one_none() -> None:
    free, crashed = Estimate(0.9, 0.8, 0.95), Estimate(0.5, 0.4, 0.6)
    (one,) = costs([row("qmix", "", 0.9, interval=free), row("qmix", "a", 0.5, interval=crashed)])
    assert one.interval == difference(free, crashed)
    (known,) = costs([row("qmix", "", 1.0), row("qmix", "a", 0.0)])
    assert (known.mean, known.interval) == (1.0, None)
    (half,) = costs([row("qmix", "", 1.0), row("qmix", "a", 0.5, interval=crashed)])
    assert half.interval == Estimate(0.5, 0.4, 0.6)
