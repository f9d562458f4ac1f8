"""The coach on recorded data: episodes weighted by how many of their robots crashed.

With N_k of N recorded episodes in which k of n robots crashed, and the law wanted

    P(k) = C(n, k) alpha^k (1 - alpha)^(n - k)

renormalised over the k that were recorded, every episode of condition k weighs

    w_k = P(k) / (N_k / N)

so that the weights' mean over the data set is 1. As factors in the loss they make its expectation
that of episodes drawn by P (importance weighting); as w_k / N they are the probabilities of
drawing episodes so.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from policy_pkg.statistics import binomial_weights
from policy_pkg.train.offline.data import DataError

Weights = npt.NDArray[np.float64]


@dataclass(frozen=True)
class CrashCondition:
    """Of the episodes in which ``crashed`` robots had a fault."""

    crashed: int
    episodes: int
    share: float  # of the recorded episodes
    target: float  # P(k), before what was not recorded is left out
    weight: float | None  # w_k; None: not recorded


@dataclass(frozen=True)
class CrashWeights:
    """``weights``: (N,) of the data set's episodes, mean 1."""

    weights: Weights
    conditions: tuple[CrashCondition, ...]

    @property
    def unrecorded(self) -> tuple[CrashCondition, ...]:
        """Conditions that the wanted law has and the recordings lack."""
        return tuple(c for c in self.conditions if c.episodes == 0 and c.target > 0)

    @property
    def effective_episodes(self) -> float:
        """Kish's effective sample size, (sum w)^2 / sum w^2."""
        return float(self.weights.sum() ** 2 / np.square(self.weights).sum())

    def to_json(self) -> dict[str, Any]:
        return {
            "effective_episodes": self.effective_episodes,
            "conditions": [vars(condition) for condition in self.conditions],
        }


def crash_weights(crashed: npt.NDArray[np.int64], n_robots: int, rate: float) -> CrashWeights:
    """Weights for crashes at ``rate`` per robot.

    Args:
        crashed: (N,) crashed robots of each recorded episode, N >= 1.

    Raises:
        DataError: no condition was recorded that has a positive probability at this rate.
    """
    counts = np.bincount(crashed, minlength=n_robots + 1)
    target = np.array(binomial_weights(n_robots, rate))
    recorded = counts > 0
    covered = float(target[recorded].sum())
    if covered <= 0:
        found = ", ".join(map(str, np.flatnonzero(recorded)))
        raise DataError(
            f"crash_rate {rate:g}: episodes with {found} of {n_robots} robots crashed were "
            "recorded, and none of these occurs at this rate"
        )
    share = counts / len(crashed)
    by_count = np.zeros(n_robots + 1)
    by_count[recorded] = target[recorded] / covered / share[recorded]
    conditions = tuple(
        CrashCondition(
            crashed=k,
            episodes=int(counts[k]),
            share=float(share[k]),
            target=float(target[k]),
            weight=float(by_count[k]) if recorded[k] else None,
        )
        for k in range(n_robots + 1)
    )
    return CrashWeights(by_count[crashed], conditions)
