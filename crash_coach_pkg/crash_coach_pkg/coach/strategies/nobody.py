"""Strategy ``none``."""

from __future__ import annotations

from typing import ClassVar

from crash_coach_pkg.coach.strategies.base import Draws, Strategy, StrategySettings


class Nobody(Strategy[StrategySettings]):
    name: ClassVar[str] = "none"
    summary: ClassVar[str] = "Nobody crashes, unless victims are named."
    crashes: ClassVar[bool] = False
    rate = 0.0
    cap = 0

    def plan(self, episode: int, draws: Draws) -> tuple[int, ...]:
        return ()
