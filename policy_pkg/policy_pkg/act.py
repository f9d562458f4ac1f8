"""From action values to actions; unavailable actions are never chosen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sim_pkg.contract import BoolArray, FloatArray, IntArray

_EXPLORATION = 0xE8910  # keeps these draws apart from the environment's of the same seed


def greedy(q: FloatArray, available: BoolArray) -> IntArray:
    """(..., A) values and availability -> (...) the best available action, the first of equals."""
    masked = np.where(available, q, np.float32(-np.inf))
    best: IntArray = masked.argmax(axis=-1).astype(np.int32)
    return best


def least_valued(q: FloatArray, available: BoolArray) -> IntArray:
    """As ``greedy``, (...) the worst available action, the first of equals: what an adversarial
    fault executes."""
    masked = np.where(available, q, np.float32(np.inf))
    worst: IntArray = masked.argmin(axis=-1).astype(np.int32)
    return worst


def epsilon_greedy(
    q: FloatArray, available: BoolArray, epsilon: float, rng: np.random.Generator
) -> IntArray:
    """Each row on its own: with probability ``epsilon`` a uniform available action, else greedy.

    q, available: (..., A). Takes the same number of draws from ``rng`` whatever the values are.
    """
    draws = rng.random((2, *q.shape[:-1]))
    return _mixed(greedy(q, available), available, epsilon, draws)


@dataclass(frozen=True)
class Exploration:
    """Epsilon-greedy choices that are keyed by (seed, episode, step, robot): whoever acts, and in
    whatever order, the same robot-step gets the same draw."""

    epsilon: float
    seed: int
    team: int  # robots of the whole team

    def choose(
        self, best: IntArray, available: BoolArray, robots: IntArray, episode: int, step: int
    ) -> IntArray:
        """(R,) with probability ``epsilon`` a uniform available action, else that of ``best``.

        robots: (R,) indexes in the team; available: (R, A).
        """
        if self.epsilon <= 0:
            return best
        key = np.array([self.seed ^ _EXPLORATION, episode], dtype=np.uint64)
        rng = np.random.Generator(np.random.Philox(key=key, counter=[0, step, 0, 0]))
        return _mixed(best, available, self.epsilon, rng.random((2, self.team))[:, robots])


def _mixed(
    best: IntArray, available: BoolArray, epsilon: float, draws: npt.NDArray[np.float64]
) -> IntArray:
    """draws: (2, ...) in [0, 1): whether to explore, and which available action then."""
    order = np.cumsum(available, axis=-1)
    pick = (draws[1] * order[..., -1]).astype(np.int64)
    uniform = np.argmax(order > pick[..., None], axis=-1)
    return np.where(draws[0] < epsilon, uniform, best).astype(np.int32)
