"""Strategy ``adaptive``: alpha += rho (1[e_t >= beta] - alpha), the paper's adaptive coach."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from crash_coach_pkg.coach.strategies.base import BlockOver, StrategySettings
from crash_coach_pkg.coach.strategies.by_rate import MovingRate


class AdaptiveSettings(StrategySettings):
    beta: float = Field(
        default=0.75,
        ge=0,
        le=1,
        description="Success rate from which the crash rate rises.",
        json_schema_extra={"unit": "1"},
    )
    rho: float = Field(
        default=0.01,
        gt=0,
        le=1,
        description="Share of the way moved per evaluation block.",
        json_schema_extra={"unit": "1"},
    )
    alpha_max: float = Field(
        default=1.0,  # the paper has no ceiling
        ge=0,
        le=1,
        description="Highest crash rate.",
        json_schema_extra={"unit": "1"},
    )


class Adaptive(MovingRate[AdaptiveSettings]):
    name: ClassVar[str] = "adaptive"
    summary: ClassVar[str] = (
        "The crash rate rises after blocks that succeed, and falls after others."
    )
    Settings: ClassVar[type[StrategySettings]] = AdaptiveSettings
    needs_success: ClassVar[bool] = True
    reads_blocks: ClassVar[bool] = True

    @property
    def highest(self) -> float:
        return self.settings.alpha_max

    def block_over(self, over: BlockOver) -> None:
        passed = 1.0 if over.success_rate >= self.settings.beta else 0.0
        self._rate = min(self.highest, self._rate + self.settings.rho * (passed - self._rate))
