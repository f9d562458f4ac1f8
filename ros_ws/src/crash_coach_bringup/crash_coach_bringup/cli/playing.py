"""Evaluations for verbs: played here or over ROS, and written as JSON."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from crash_coach_bringup.cli.options import (
    Layout,
    Via,
)
from crash_coach_bringup.cli.output import (
    CliError,
    tell_note,
)
from policy_pkg.play.conditions import Condition
from policy_pkg.play.evaluate import Evaluation
from policy_pkg.play.evaluate_processes import evaluate_on
from policy_pkg.play.target import Target
from policy_pkg.statistics import Estimate, difference

ALIKE = "1 episode: all went alike and nothing in them is left to chance, so there is no interval."


def play(
    target: Target,
    conditions: list[Condition],
    episodes: int,
    seed: int,
    processes: int,
    via: Via,
    layout: Layout,
) -> list[Evaluation]:
    """Each condition's evaluation, in processes of this machine or as a ROS graph.

    Raises:
        CliError: several graphs.
    """
    tell_note(target.note)
    if via is Via.core:
        return evaluate_on(processes, target.team, target.source, conditions, episodes, seed)
    if processes > 1:
        raise CliError(f"--processes {processes}: with --via ros one graph plays all episodes")
    from crash_coach_bringup.ros.evaluation import evaluate_via_ros

    checkpoint, scenario = Path(target.name), target.file
    return [
        evaluate_via_ros(checkpoint, scenario, condition, episodes, seed, layout.value)
        for condition in conditions
    ]


def as_json(results: list[tuple[Condition, Evaluation]]) -> list[dict[str, Any]]:
    """Each condition's summary and episodes."""
    return [
        {
            "name": condition.name,
            "crash": condition.crash.model_dump(mode="json"),
            **result.summary(),
            **_cost_json(results, condition, result),
            "per_episode": [asdict(episode) for episode in result.episodes],
        }
        for condition, result in results
    ]


def cost(free: Evaluation, crashed: Evaluation) -> Estimate:
    """How much lower the success rate is than ``free``'s."""
    return difference(free.success, crashed.success)


def crash_free_of(results: list[tuple[Condition, Evaluation]]) -> Evaluation | None:
    """What a crash costs is counted from; None where nobody knows what a success is."""
    free = (result for condition, result in results if condition.crashed == 0)
    return next((result for result in free if result.reports_success), None)


def _cost_json(
    results: list[tuple[Condition, Evaluation]], condition: Condition, result: Evaluation
) -> dict[str, Any]:
    """``cost`` and its interval, of a condition with crashes beside a crash-free one."""
    free = crash_free_of(results)
    if free is None or condition.crashed == 0:
        return {}
    found = cost(free, result)
    return {"cost": found.value, "cost_ci95": [found.low, found.high]}
