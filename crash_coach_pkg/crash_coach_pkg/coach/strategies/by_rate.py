"""Strategies that have a crash rate, by which every robot crashes on its own."""

from __future__ import annotations

from abc import ABC

import numpy as np

from crash_coach_pkg.coach.strategies.base import Draws, Progress, S, State, Strategy
from crash_coach_pkg.coach.victims import draw_mask


class ByRate(Strategy[S], ABC):
    """Each candidate crashes with probability ``rate``; re-sampled up to the cap."""

    @property
    def cap(self) -> int:
        return self.candidates.cap(self.rate)

    def plan(self, episode: int, draws: Draws) -> tuple[int, ...]:
        mask = draw_mask(draws.of_episode(episode), self.candidates.n, self.rate, self.cap)
        return tuple(np.flatnonzero(mask).tolist())


class MovingRate(ByRate[S], ABC):
    """The rate is its state; it starts at 0."""

    _rate = 0.0

    @property
    def highest(self) -> float:
        """The rate's ceiling."""
        return 1.0

    @property
    def rate(self) -> float:
        return self._rate

    def take_over(self, rate: float, progress: Progress) -> None:
        self._rate = min(self.highest, rate)

    def state_dict(self) -> State:
        return {"rate": self._rate}

    def load_state_dict(self, state: State) -> None:
        self.check_keys(state)
        rate = float(state["rate"])
        if not 0 <= rate <= 1:
            raise ValueError(f"state of strategy {self.name}: rate {rate} is not in [0, 1]")
        self._rate = min(self.highest, rate)
