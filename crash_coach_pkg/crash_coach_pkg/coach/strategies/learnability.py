"""Strategy ``learnability``: what succeeds now and then is where there is most to learn."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from crash_coach_pkg.coach.strategies.arms import Arms, ArmsSettings, Weights
from crash_coach_pkg.coach.strategies.base import StrategySettings


class LearnabilitySettings(ArmsSettings):
    even: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="Share of the episodes that is even over the arms; the others are in "
        "proportion to p (1 - p), p the arm's running success.",
        json_schema_extra={"unit": "1"},
    )


class Learnability(Arms[LearnabilitySettings]):
    """Sampling for learnability (Rutherford et al. 2024), over who crashes."""

    name: ClassVar[str] = "learnability"
    summary: ClassVar[str] = "Nobody, a robot or a pair: those most often whose success is open."
    Settings: ClassVar[type[StrategySettings]] = LearnabilitySettings

    def weights(self, success: Weights) -> Weights:
        even = np.full_like(success, 1 / len(success))
        learnable = success * (1 - success)
        if not learnable.any():
            return even
        share = self.settings.even
        weighed: Weights = share * even + (1 - share) * learnable / learnable.sum()
        return weighed
