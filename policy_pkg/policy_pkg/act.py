"""From action values to actions; unavailable actions are never chosen."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import BoolArray, FloatArray, IntArray

_LOWEST, _HIGHEST = np.float32(-np.inf), np.float32(np.inf)
_EXPLORATION = 0xE8910  # keeps these draws apart from the environment's of the same seed


def greedy(q: FloatArray, available: BoolArray) -> IntArray:
    """(..., A) values and availability -> (...) the best available action, the first of equals."""
    masked = np.where(available, q, _LOWEST)
    best: IntArray = masked.argmax(axis=-1).astype(np.int32)
    return best


def least_valued(q: FloatArray, available: BoolArray) -> IntArray:
    """As ``greedy``, (...) the worst available action, the first of equals: what an adversarial
    fault executes."""
    masked = np.where(available, q, _HIGHEST)
    worst: IntArray = masked.argmin(axis=-1).astype(np.int32)
    return worst


def best_and_worst(q: FloatArray, available: BoolArray) -> list[tuple[int, int]]:
    """Of each of R rows, (R, A), what ``greedy`` and ``least_valued`` choose; -1 where no action is
    available.

    For the few robots of a policy node: there each of numpy's calls costs more than their rows.
    """
    chosen = []
    for values, possible in zip(q.tolist(), available.tolist(), strict=True):
        best = worst = -1
        highest, lowest = -math.inf, math.inf
        for action, value in enumerate(values):
            if possible[action]:
                if value > highest:
                    best, highest = action, value
                if value < lowest:
                    worst, lowest = action, value
        chosen.append((best, worst))
    return chosen


class Explorer:
    """Epsilon-greedy for B teams of n robots, each robot on its own; a random action may last.

    A random action, once drawn, is held for d steps, P(d) proportional to 1 / (d (d + 1)),
    d <= ``longest``, while it is available: temporally extended epsilon-greedy (Dabney et al.
    2021). They start so rarely that epsilon stays the share of random steps.

    longest: 1: every random action is drawn anew, plain epsilon-greedy.
    """

    def __init__(self, arenas: int, robots: int, longest: int = 1) -> None:
        if longest < 1:
            raise ValueError(f"longest random action: {longest} steps; must be at least 1")
        self.action: IntArray = np.zeros((arenas, robots), dtype=np.int32)
        """(B, n) held."""
        self.left: IntArray = np.zeros((arenas, robots), dtype=np.int32)
        """(B, n) further steps for which it is held."""
        steps = np.arange(1, longest + 1)
        # sum of 1 / (k (k + 1)) up to d is d / (d + 1)
        self._up_to = steps / (steps + 1) * (longest + 1) / longest
        self._mean_steps = float(np.sum(1 / (steps + 1))) * (longest + 1) / longest

    @property
    def lasting(self) -> bool:
        return len(self._up_to) > 1

    def begin(self, arenas: npt.NDArray[np.intp]) -> None:
        """Nothing is held in ``arenas`` any more: episodes start there."""
        self.left[arenas] = 0

    def choose(
        self, q: FloatArray, available: BoolArray, epsilon: float, rng: np.random.Generator
    ) -> IntArray:
        """(B, n) actions for (B, n, A) values and availability; goes on by a step.

        Takes the same number of draws from ``rng`` whatever the values are.
        """
        best = greedy(q, available)
        draws = rng.random((3 if self.lasting else 2, *best.shape))
        if not self.lasting:
            return _mixed(best, available, epsilon, draws)
        possible = np.take_along_axis(available, self.action[..., np.newaxis], -1)[..., 0]
        held = (self.left > 0) & possible
        # Of all steps that are not held a share p starts a random action of m steps on average:
        # p m / (p m + 1 - p) of the steps are random, which is to be epsilon.
        share = epsilon / (self._mean_steps * (1 - epsilon) + epsilon)
        starts = ~held & (draws[0] < share)
        fresh = _mixed(best, available, share, draws[:2])
        steps = np.searchsorted(self._up_to, draws[2], side="right") + 1
        chosen: IntArray = np.where(held, self.action, fresh).astype(np.int32)
        left = np.where(starts, np.minimum(steps, len(self._up_to)), np.where(held, self.left, 1))
        self.action, self.left = chosen.copy(), (left - 1).astype(np.int32)
        return chosen


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
