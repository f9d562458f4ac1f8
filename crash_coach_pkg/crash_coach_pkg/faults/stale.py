"""Stale: the policy's picture of the world stands still."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from crash_coach_common.contract import FloatArray
from crash_coach_pkg.faults.base import ObservationFault, Step


class Stale(ObservationFault):
    name: ClassVar[str] = "stale"
    code: ClassVar[int] = 21
    summary: ClassVar[str] = (
        "The policy keeps seeing what it saw in the step before the fault; zeros where that was "
        "nothing."
    )

    def __init__(self, parameters: object) -> None:
        super().__init__(parameters)
        self._held: FloatArray | None = None

    def apply(self, step: Step, features: FloatArray, last: FloatArray | None) -> FloatArray:
        if self._held is None:
            self._held = np.zeros_like(features) if last is None else last
        return self._held
