"""Bias: a constant velocity on top of the commanded one."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from crash_coach_pkg.faults.base import C, CommandFault, FaultParameters, Need, Step, Tools


def _velocity(description: str, unit: str) -> Any:
    return Field(
        default=0.0, ge=-10, le=10, description=description, json_schema_extra={"unit": unit}
    )


class BiasParameters(FaultParameters):
    linear_x_m_s: float = _velocity("Added to linear.x (forward).", "m/s")
    linear_y_m_s: float = _velocity("Added to linear.y (left).", "m/s")
    angular_z_rad_s: float = _velocity("Added to angular.z (counter-clockwise).", "rad/s")


class Bias(CommandFault[C]):
    name: ClassVar[str] = "bias"
    code: ClassVar[int] = 6
    summary: ClassVar[str] = "A constant velocity is added to every command (Twist types only)."
    Parameters: ClassVar[type[FaultParameters]] = BiasParameters
    needs: ClassVar[frozenset[Need]] = frozenset(("vector",))

    def __init__(self, parameters: BiasParameters) -> None:
        super().__init__(parameters)
        p = parameters
        self._added = np.array([p.linear_x_m_s, p.linear_y_m_s, 0, 0, 0, p.angular_z_rad_s])

    def apply(self, step: Step, command: C, last: C | None, tools: Tools[C]) -> C | None:
        return tools.with_vector(command, tools.vector(command) + self._added)
