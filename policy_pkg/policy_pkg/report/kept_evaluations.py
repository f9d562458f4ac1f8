"""Evaluations that are kept in a folder: what was played once is read again, so reports resume."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from crash_coach_common.whole_output import write_whole
from policy_pkg.checkpoint import load_policy
from policy_pkg.play.conditions import Condition
from policy_pkg.play.evaluate import evaluate, evaluation_seed
from policy_pkg.report.finished_runs import Run
from policy_pkg.report.training import Training, training_of
from policy_pkg.statistics import Estimate, wilson
from policy_pkg.train.run_dir import RunError
from sim_pkg.env import ScenarioLike, make_any_env

FORMAT = 3  # of what is kept; a new number makes everything be played again


@dataclass(frozen=True)
class Outcome:
    """What one run did under one condition; means are over its episodes.

    ``alike``: the same episode again and again, see Evaluation.alike.
    """

    successes: int
    episodes: int
    alike: bool
    return_mean: float
    steps_mean: float
    trajectory_hash: str

    @property
    def success(self) -> float:
        return self.successes / self.episodes

    @property
    def estimate(self) -> Estimate:
        """Success rate with Wilson's interval; without width where nothing is left to chance."""
        if self.alike:
            return Estimate(self.success, self.success, self.success)
        return wilson(self.successes, self.episodes)

    @property
    def counts(self) -> tuple[int, int]:
        """Successes and episodes, of which those that are alike are one."""
        return (
            (self.successes // self.episodes, 1) if self.alike else (self.successes, self.episodes)
        )


@dataclass(frozen=True)
class Result:
    """A run and its outcomes, in the order in which the conditions were asked for."""

    run: Run
    outcomes: Sequence[tuple[Condition, Outcome]]
    training: Training


@dataclass(frozen=True)
class Evaluations:
    """Plays ``episodes`` greedy episodes of ``seed`` per condition, or reads what they gave.

    ``folder``/<run>.json holds each run's outcomes by a key over the agent's weights, the
    scenario's settings, the condition, the episodes and the seed. The key does not cover the
    program: after changing it, give another folder.
    """

    folder: Path
    episodes: int
    seed: int

    def result(
        self, run: Run, conditions: Sequence[Condition], playing: Callable[[Condition], None]
    ) -> Result:
        """Every condition's outcome.

        Args:
            playing: told of each condition that is not kept, before it is played.

        Raises:
            UserError: the checkpoint or a condition does not fit, or a kept file is damaged.
            OSError: the folder cannot be written.
        """
        path = self._path(run)
        kept = _read(path)
        outcomes = []
        for condition in conditions:
            key = self._key(run, condition)
            if key not in kept:
                playing(condition)
                kept[key] = {"condition": condition.name, **asdict(self._play(run, condition))}
                _write(path, kept)
            figures = {k: v for k, v in kept[key].items() if k != "condition"}
            outcomes.append((condition, Outcome(**figures)))
        return Result(run, outcomes, training_of(run))

    def lacking(self, run: Run, conditions: Sequence[Condition]) -> int:
        """How many of the conditions are still to be played.

        Raises:
            RunError: a kept file is damaged.
        """
        kept = _read(self._path(run))
        return sum(self._key(run, condition) not in kept for condition in conditions)

    def _path(self, run: Run) -> Path:
        return self.folder / f"{run.path.resolve().name}.json"

    def _key(self, run: Run, condition: Condition) -> str:
        about = {
            "format": FORMAT,
            "agent": run.agent,
            "scenario": arena(run.source)[1],
            "crash": condition.crash.model_dump(mode="json"),
            "episodes": self.episodes,
            "seed": self.seed,
        }
        return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()

    def _play(self, run: Run, condition: Condition) -> Outcome:
        bundle = load_policy(run.checkpoint)
        key = evaluation_seed(self.seed)
        found = evaluate(bundle, run.source, condition, self.episodes, key)
        if not found.reports_success:
            raise RunError(
                f"{run.path}: scenario {run.scenario!r} reports no success, which a report "
                "compares: train with env_rules.success_return or env_rules.success_info"
            )
        figures = found.summary()
        return Outcome(
            successes=sum(episode.success for episode in found.episodes),
            episodes=len(found.episodes),
            alike=found.alike,
            return_mean=figures["return_mean"],
            steps_mean=figures["steps_mean"],
            trajectory_hash=figures["trajectory_hash"],
        )


@cache
def arena(scenario: ScenarioLike) -> tuple[tuple[str, ...], str]:
    """A scenario's robots, and its settings as JSON.

    Raises:
        ConfigError: unknown or wrong scenario.
    """
    env = make_any_env(scenario, 1)
    return env.spec.robots, env.config.model_dump_json()


def _read(path: Path) -> dict[str, dict[str, Any]]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return {key: _checked(figures) for key, figures in content.items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise RunError(f"{path} is damaged, delete it: {error}") from error


def _checked(figures: Mapping[str, Any]) -> dict[str, Any]:
    Outcome(**{key: value for key, value in figures.items() if key != "condition"})
    return dict(figures)


def _write(path: Path, kept: Mapping[str, Any]) -> None:
    write_whole(path, (json.dumps(kept, indent=1) + "\n").encode())
