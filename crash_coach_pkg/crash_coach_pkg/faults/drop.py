"""Drop: commands get lost, one by one or in bursts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

from pydantic import Field

from crash_coach_pkg.faults.base import C, CommandFault, FaultParameters, Step, Tools

_LOSS, _CHANGE = 1, 2  # streams


def _probability(default: float, example: float, description: str) -> Any:
    return Field(
        default=default, ge=0, le=1, description=description, examples=[example],
        json_schema_extra={"unit": "1"},
    )  # fmt: skip


class DropParameters(FaultParameters):
    probability: float = _probability(0.5, 0.02, "Probability that a step's command is lost.")
    burst_probability: float = _probability(1.0, 0.9, "The same within a burst.")
    to_bad: float = _probability(0.0, 0.05, "Probability per step that a burst begins.")
    to_good: float = _probability(
        1.0, 0.25, "Probability per step that a burst ends: it lasts 1 / to_good steps on average."
    )


class Drop(CommandFault[C]):
    """Two-state chain of Gilbert (1960) and Elliott (1963); the stretch begins in the good state.

    The state goes on by a transition per step, whether or not a command comes in it.
    """

    name: ClassVar[str] = "drop"
    code: ClassVar[int] = 5
    draws: ClassVar[bool] = True
    summary: ClassVar[str] = (
        "Commands get lost with a probability per step; in bursts where to_bad is above 0 "
        "(Gilbert-Elliott)."
    )
    Parameters: ClassVar[type[FaultParameters]] = DropParameters

    def __init__(self, parameters: DropParameters) -> None:
        super().__init__(parameters)
        self._odds = parameters
        self._bad = False
        self._at: int | None = None  # the step that the state belongs to

    def apply(self, step: Step, command: C, last: C | None, tools: Tools[C]) -> C | None:
        for passed in range(step.step if self._at is None else self._at, step.step):
            change = self._odds.to_good if self._bad else self._odds.to_bad
            if replace(step, step=passed + 1).uniform(_CHANGE) < change:
                self._bad = not self._bad
        self._at = step.step
        lost = self._odds.burst_probability if self._bad else self._odds.probability
        return None if step.uniform(_LOSS) < lost else command
