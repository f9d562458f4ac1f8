"""Strategy ``fixed``: alpha is constant."""

from __future__ import annotations

from typing import ClassVar

from crash_coach_pkg.coach.strategies.base import Draws, StrategySettings
from crash_coach_pkg.coach.strategies.by_rate import ByRate


class Fixed(ByRate[StrategySettings]):
    name: ClassVar[str] = "fixed"
    summary: ClassVar[str] = "Each robot crashes with probability crash_rate."

    @property
    def rate(self) -> float:
        return self.candidates.crash_rate

    def plan(self, episode: int, draws: Draws) -> tuple[int, ...]:
        if self.candidates.triggered and self.rate == 0:
            return tuple(range(self.candidates.n))  # no draw before the hazard's or condition's
        return super().plan(episode, draws)
