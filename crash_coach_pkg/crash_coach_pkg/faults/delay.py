"""Delay: commands arrive some steps late."""

from __future__ import annotations

from collections import deque
from typing import ClassVar

from pydantic import Field

from crash_coach_pkg.faults.base import C, CommandFault, FaultParameters, Need, Step, Tools


class DelayParameters(FaultParameters):
    steps: int = Field(
        default=3,
        ge=1,
        le=1000,
        description="Age at which a command arrives.",
        json_schema_extra={"unit": "steps"},
    )


class Delay(CommandFault[C]):
    name: ClassVar[str] = "delay"
    code: ClassVar[int] = 4
    summary: ClassVar[str] = (
        "Commands arrive late: each step passes on the newest one that is old enough, once; "
        "nothing in the first steps of the fault, or where it is not available any more. Commands "
        "still under way when the fault ends are lost."
    )
    Parameters: ClassVar[type[FaultParameters]] = DelayParameters
    needs: ClassVar[frozenset[Need]] = frozenset(("availability",))

    def __init__(self, parameters: DelayParameters) -> None:
        super().__init__(parameters)
        self._steps = parameters.steps
        self._under_way: deque[tuple[int, C]] = deque()

    def apply(self, step: Step, command: C, last: C | None, tools: Tools[C]) -> C | None:
        self._under_way.append((step.step, command))
        return self.idle(step)

    def idle(self, step: Step) -> C | None:
        arrived = None
        while self._under_way and self._under_way[0][0] <= step.step - self._steps:
            arrived = self._under_way.popleft()[1]
        return arrived
