"""Noise: what the policy sees is disturbed."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from crash_coach_common.contract import FloatArray
from crash_coach_pkg.faults.base import FaultParameters, ObservationFault, Step

_STREAM = 3


class NoiseParameters(FaultParameters):
    stddev: float = Field(
        default=0.1,
        ge=0,
        le=10,
        description="Standard deviation, in units of the scaled features (about [-1, 1]).",
        json_schema_extra={"unit": "1"},
    )


class Noise(ObservationFault):
    name: ClassVar[str] = "noise"
    code: ClassVar[int] = 22
    draws: ClassVar[bool] = True
    summary: ClassVar[str] = "Gaussian noise, new in each step, is added to every feature."
    Parameters: ClassVar[type[FaultParameters]] = NoiseParameters

    def __init__(self, parameters: NoiseParameters) -> None:
        super().__init__(parameters)
        self._stddev = np.float32(parameters.stddev)

    def apply(self, step: Step, features: FloatArray, last: FloatArray | None) -> FloatArray:
        rng = np.random.Generator(np.random.Philox(key=step.bits(_STREAM)))
        noise = rng.standard_normal(features.shape, dtype=np.float32)
        return features + self._stddev * noise
