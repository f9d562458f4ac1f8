"""Scale: velocities are multiplied."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from crash_coach_pkg.faults.base import C, CommandFault, FaultParameters, Need, Step, Tools


def _factor(description: str) -> Any:
    return Field(
        default=1.0, ge=-10, le=10, description=description, json_schema_extra={"unit": "1"}
    )


class ScaleParameters(FaultParameters):
    linear: float = _factor("Factor of the linear velocity.")
    angular: float = _factor("Factor of the angular velocity.")


class Scale(CommandFault[C]):
    name: ClassVar[str] = "scale"
    code: ClassVar[int] = 7
    summary: ClassVar[str] = "The velocities of every command are multiplied (Twist types only)."
    Parameters: ClassVar[type[FaultParameters]] = ScaleParameters
    needs: ClassVar[frozenset[Need]] = frozenset(("vector",))

    def __init__(self, parameters: ScaleParameters) -> None:
        super().__init__(parameters)
        self._factors = np.repeat([parameters.linear, parameters.angular], 3)

    def apply(self, step: Step, command: C, last: C | None, tools: Tools[C]) -> C | None:
        return tools.with_vector(command, tools.vector(command) * self._factors)
