"""Strategy ``patient``: nobody crashes until the task is learned, then as under ``fixed``."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from crash_coach_pkg.coach.strategies.base import BlockOver, Progress, State, StrategySettings
from crash_coach_pkg.coach.strategies.by_rate import ByRate


class PatientSettings(StrategySettings):
    success: float = Field(
        default=0.8,
        ge=0,
        le=1,
        description="Success rate of a block without crashes after which they begin.",
        json_schema_extra={"unit": "1"},
    )


class Patient(ByRate[PatientSettings]):
    name: ClassVar[str] = "patient"
    summary: ClassVar[str] = (
        "Nobody until a block succeeds; then each robot with probability crash_rate."
    )
    Settings: ClassVar[type[StrategySettings]] = PatientSettings
    needs_success: ClassVar[bool] = True
    reads_blocks: ClassVar[bool] = True

    _begun = False

    @property
    def rate(self) -> float:
        return self.candidates.crash_rate if self._begun else 0.0

    def block_over(self, over: BlockOver) -> None:
        self._begun = self._begun or over.success_rate >= self.settings.success

    def take_over(self, rate: float, progress: Progress) -> None:
        self._begun = rate > 0

    def state_dict(self) -> State:
        return {"begun": self._begun}

    def load_state_dict(self, state: State) -> None:
        self.check_keys(state)
        if not isinstance(state["begun"], bool):
            raise ValueError(f"state of strategy {self.name}: begun {state['begun']!r} is no bool")
        self._begun = state["begun"]
