"""Results as marl-eval reads them (Gorsane et al. 2022)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from policy_pkg.play.conditions import Condition
from policy_pkg.report.kept_evaluations import Outcome, Result

ENVIRONMENT = "crash_coach"


def as_marl_eval(results: Sequence[Result]) -> dict[str, Any]:
    """JSON values. Metrics are ``win_rate`` and ``mean_episode_return``, of one element each.

    An environment is a condition, a task a map, and a run its seed. Crash-free, the steps are a
    run's own evaluation blocks, where it kept them; otherwise there is one step, what the report
    measured. ``absolute_metrics`` are what the report measured.
    """
    found: dict[str, Any] = {}
    for result in results:
        for condition, outcome in result.outcomes:
            tasks = found.setdefault(f"{ENVIRONMENT}, {condition.name}", {})
            methods = tasks.setdefault(result.run.scenario, {})
            runs = methods.setdefault(result.run.method, {})
            runs[f"seed_{result.run.seed}"] = _run(result, condition, outcome)
    return found


def _run(result: Result, condition: Condition, outcome: Outcome) -> dict[str, Any]:
    final = _metrics(outcome.success, outcome.return_mean)
    steps = [(result.run.steps, final)]
    if condition.crashed == 0 and result.training.blocks and not result.run.is_best:
        steps = [(step, _metrics(*figures)) for step, *figures in result.training.blocks]
    out: dict[str, Any] = {
        f"step_{number}": {"step_count": step, **metrics}
        for number, (step, metrics) in enumerate(steps, start=1)
    }
    return {**out, "absolute_metrics": final}


def _metrics(success: float, episode_return: float) -> dict[str, list[float]]:
    return {"win_rate": [success], "mean_episode_return": [episode_return]}
