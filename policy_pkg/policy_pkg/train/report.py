"""Many runs under many conditions: what each method achieves over its seeds, and how sure that is.

Every run plays the same episodes under every condition, so methods are paired. What was evaluated
is kept in a folder and not evaluated again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from policy_pkg.checkpoint import load_policy
from policy_pkg.train.evaluate import Condition, evaluate
from policy_pkg.train.results import Run, RunError
from policy_pkg.train.statistics import (
    Estimate,
    binomial_weights,
    bootstrap_interquartile_mean,
    mean_interval,
    probability_of_improvement,
    reweighted_success,
    wilson,
)
from sim_pkg.env import make_env

ALL_MAPS = "all maps"
LEAST_SEEDS = 3  # of either method, for a probability of improvement
FORMAT = 1  # of the kept evaluations; a new number makes all of them be played again
Scores = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Outcome:
    """What one run did under one condition; means are over its episodes."""

    successes: int
    episodes: int
    return_mean: float
    steps_mean: float
    trajectory_hash: str

    @property
    def success(self) -> float:
        return self.successes / self.episodes


@dataclass(frozen=True)
class Result:
    """A run's outcomes by the condition's name, in the order in which they were asked for."""

    run: Run
    robots: int
    outcomes: Mapping[str, Outcome]


@dataclass(frozen=True)
class Row:
    """A method on a map under a condition. ``success``: of each seed; so are ``returns``.

    ``interval``: of the mean; Student's t over seeds; for a single seed Wilson's over episodes, or
    that of the re-weighted estimate. ``iqm``: None for a single seed. ``not_measured``: the
    largest probability of a number of crashed robots that a re-weighted estimate had no result
    for, and counted as failure. A row over all maps has the maps' means in ``success``.
    """

    method: str
    scenario: str
    condition: str
    seeds: tuple[int, ...]
    success: tuple[float, ...]
    interval: Estimate | None
    iqm: Estimate | None
    returns: tuple[float, ...] = ()
    not_measured: float = 0.0

    @property
    def mean(self) -> float:
        return float(np.mean(self.success))

    @property
    def std(self) -> float | None:
        """The sample's, over seeds; None for a single one and over maps."""
        if len(self.seeds) < 2 or self.scenario == ALL_MAPS:
            return None
        return float(np.std(self.success, ddof=1))


@dataclass(frozen=True)
class Improvement:
    """How probable it is that a run of one method succeeds more often than one of another."""

    better: str
    worse: str
    condition: str
    scenarios: tuple[str, ...]
    estimate: Estimate


@dataclass
class Evaluations:
    """Evaluations by what went into them, in ``folder``/<run>.json.

    The key covers the agent's weights, the scenario's settings, the condition, the number of
    episodes and the seed; it does not cover the program itself.
    """

    folder: Path
    episodes: int
    seed: int
    _settings: dict[str, tuple[str, int]] = field(default_factory=dict)

    def results(
        self,
        run: Run,
        conditions: Callable[[tuple[str, ...]], Sequence[tuple[str, Condition]]],
        played: Callable[[str], None],
    ) -> Result:
        """Reads or plays every condition.

        Args:
            conditions: robots -> the conditions and their names.
            played: told of each condition that had to be played, before it is.

        Raises:
            UserError: the checkpoint or a condition does not fit, or a kept file is damaged.
            OSError: the folder cannot be written.
        """
        scenario, n_robots = self._scenario(run.scenario)
        path = self.folder / f"{run.path.resolve().name}.json"
        kept = _read_kept(path)
        outcomes: dict[str, Outcome] = {}
        for name, condition in conditions(make_robots(n_robots)):
            key = self._key(run, scenario, condition)
            if key not in kept:
                played(name)
                kept[key] = {"condition": name, **asdict(self._play(run, condition))}
                _write_kept(path, kept)
            outcomes[name] = Outcome(**{k: v for k, v in kept[key].items() if k != "condition"})
        return Result(run, n_robots, outcomes)
