"""All that a report says, before it is written as page, JSON, figures or tables for other tools."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from policy_pkg.report.coping import Coping, coping
from policy_pkg.report.finished_runs import differences, last_metrics, wall_time_s
from policy_pkg.report.kept_evaluations import Result
from policy_pkg.report.paired import PairedDifference, paired_differences
from policy_pkg.report.rows import (
    THRESHOLDS,
    Improvement,
    Profile,
    Row,
    improvements,
    profiles,
    rows,
)
from policy_pkg.report.victims import Cost, costs


@dataclass(frozen=True)
class Findings:
    """``about``: episodes, seed, key, mode, parameters, against, runs without_checkpoint; ``runs``:
    as ``describe`` gives them; ``differences``: in training between the maps."""

    about: Mapping[str, Any]
    rows: Sequence[Row]
    paired: Sequence[PairedDifference]
    costs: Sequence[Cost]
    coping: Sequence[Coping]
    improvements: Sequence[Improvement]
    profiles: Sequence[Profile]
    runs: Sequence[Mapping[str, Any]]
    differences: Sequence[str]

    @classmethod
    def of(
        cls, about: Mapping[str, Any], results: Sequence[Result], rates: Sequence[float]
    ) -> Findings:
        """``rates``: to be estimated from exact numbers of crashed robots."""
        found = rows(results, rates)
        return cls(
            about=about,
            rows=found,
            paired=paired_differences(found, about["against"]),
            costs=costs(found),
            coping=coping(results),
            improvements=improvements(found),
            profiles=profiles(found),
            runs=[describe(result) for result in results],
            differences=differences([result.run for result in results]),
        )

    def to_json(self) -> dict[str, Any]:
        """JSON values."""
        return {
            **self.about,
            "rows": [asdict(row) for row in self.rows],
            "paired_differences": [asdict(each) for each in self.paired],
            "costs": [asdict(each) for each in self.costs],
            "coping": [asdict(each) for each in self.coping],
            "improvements": [asdict(each) for each in self.improvements],
            "thresholds": THRESHOLDS.tolist(),
            "profiles": [asdict(each) for each in self.profiles],
            "runs": list(self.runs),
        }


def describe(result: Result) -> dict[str, Any]:
    """A run in figures, JSON values; null where its directory does not tell."""
    run, metrics = result.run, last_metrics(result.run.path)
    return {
        "run": str(run.path),
        "scenario": run.scenario,
        "method": run.method,
        "seed": run.seed,
        "steps": run.steps,
        "checkpoint": "best" if run.is_best else "last",
        "checkpoint_steps": run.checkpoint_steps,
        "total_steps": run.total_steps,
        "settings": run.settings,
        "gradient_steps": metrics.get("gradient_steps"),
        "new_alpha": metrics.get("new_alpha"),
        "wall_s": wall_time_s(run.path),
        **_training(result),
        "victims": {c.name: c.victim for c, _ in result.outcomes if c.victim},
        "outcomes": {condition.name: asdict(outcome) for condition, outcome in result.outcomes},
    }


def _training(result: Result) -> dict[str, Any]:
    training = result.training
    return {
        "training_episodes": training.episodes,
        "evaluation_episodes": training.evaluation_episodes,
        "crash_free_last_blocks": training.last_blocks,
    }
