"""Strategy ``failure``: what fails is practised."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from crash_coach_pkg.coach.strategies.arms import Arms, ArmsSettings, Weights
from crash_coach_pkg.coach.strategies.base import StrategySettings


class FailureSettings(ArmsSettings):
    floor: float = Field(
        default=0.1,
        gt=0,
        le=1,
        description="Failure rate that an arm counts with at least, so that none is forgotten.",
        json_schema_extra={"unit": "1"},
    )


class Failure(Arms[FailureSettings]):
    name: ClassVar[str] = "failure"
    summary: ClassVar[str] = "Nobody, a robot or a pair: each in proportion to how often it fails."
    Settings: ClassVar[type[StrategySettings]] = FailureSettings

    def weights(self, success: Weights) -> Weights:
        failure = np.maximum(self.settings.floor, 1 - success)
        shares: Weights = failure / failure.sum()
        return shares
