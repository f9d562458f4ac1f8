"""Blind: the policy sees zeros."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from crash_coach_common.contract import FloatArray
from crash_coach_pkg.faults.base import ObservationFault, Step


class Blind(ObservationFault):
    name: ClassVar[str] = "blind"
    code: ClassVar[int] = 20
    summary: ClassVar[str] = "The policy sees zeros instead of every feature."

    def apply(self, step: Step, features: FloatArray, last: FloatArray | None) -> FloatArray:
        return np.zeros_like(features)
