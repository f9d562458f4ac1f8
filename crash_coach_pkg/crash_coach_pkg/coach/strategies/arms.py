"""Strategies that weigh arms: nobody, each robot, a random pair, by how training episodes went."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Self, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import Field

from crash_coach_pkg.coach.strategies.base import (
    Candidates,
    Draws,
    EpisodeOver,
    State,
    Strategy,
    StrategySettings,
)

Weights = npt.NDArray[np.float64]
_PAIR = (-1, -1)


class ArmsSettings(StrategySettings):
    memory_episodes: int = Field(
        default=100,
        ge=1,
        le=1_000_000,
        description="Episodes of an arm that its running success looks back.",
        json_schema_extra={"unit": "episodes"},
    )


A = TypeVar("A", bound=ArmsSettings)


class Arms(Strategy[A], ABC):
    """The arms that the limits allow, and the running success of each, which starts at 1/2."""

    needs_success: ClassVar[bool] = True

    def __init__(self, settings: A, candidates: Candidates) -> None:
        super().__init__(settings, candidates)
        limit = candidates.n if candidates.triggered else candidates.most
        self._arms: list[tuple[int, ...]] = [()]
        self._arms += [(i,) for i in range(candidates.n) if limit >= 1]
        self._arms += [_PAIR] if min(limit, candidates.n) >= 2 else []
        self._success = len(self._arms) * [0.5]
        self._counts = len(self._arms) * [1]  # the start counts as one episode
        self._weigh()

    @abstractmethod
    def weights(self, success: Weights) -> Weights:
        """(A,) how probable each arm is, from its running success, (A,); sums to 1."""
        ...

    def _weigh(self) -> None:
        """Call when the running success changed: every episode is planned by it."""
        probabilities = self.weights(np.array(self._success))
        self._cumulative = np.cumsum(probabilities)
        crashed = probabilities @ np.array([float(len(arm)) for arm in self._arms])
        self._rate = min(1.0, float(crashed) / self.candidates.n)

    @property
    def rate(self) -> float:
        return self._rate

    @property
    def cap(self) -> int:
        return len(self._arms[-1])

    def plan(self, episode: int, draws: Draws) -> tuple[int, ...]:
        rng, last = draws.of_episode(episode), self._cumulative[-1]
        index = np.searchsorted(self._cumulative, rng.random() * last, side="right")
        arm = self._arms[min(int(index), len(self._arms) - 1)]
        if arm != _PAIR:
            return arm
        return tuple(sorted(rng.permutation(self.candidates.n)[:2].tolist()))

    def episode_over(self, over: EpisodeOver) -> None:
        arm = _PAIR if len(over.crashed) == 2 else over.crashed
        if arm not in self._arms:
            return  # somebody named the victims
        index = self._arms.index(arm)
        self._counts[index] = min(self._counts[index] + 1, self.settings.memory_episodes)
        self._success[index] += (over.success - self._success[index]) / self._counts[index]
        self._weigh()

    def continue_from(self, before: Self) -> None:
        for index, arm in enumerate(self._arms):
            if arm in before._arms:
                old = before._arms.index(arm)
                self._success[index] = before._success[old]
                self._counts[index] = before._counts[old]
        self._weigh()

    def state_dict(self) -> State:
        return {"success": list(self._success), "counts": list(self._counts)}

    def load_state_dict(self, state: State) -> None:
        self.check_keys(state)
        success, counts = list(map(float, state["success"])), list(map(int, state["counts"]))
        if not len(success) == len(counts) == len(self._arms):
            raise ValueError(
                f"state of strategy {self.name} has {len(success)} arms, not {len(self._arms)}"
            )
        if not all(0 <= p <= 1 for p in success) or min(counts) < 1:
            raise ValueError(f"state of strategy {self.name} is out of range: {state}")
        self._success, self._counts = success, counts
        self._weigh()
