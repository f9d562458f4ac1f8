"""Strategy ``curriculum``: alpha grows linearly from 0 to alpha_max and stays there."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from crash_coach_common.contract import UserError
from crash_coach_pkg.coach.strategies.base import (
    BlockOver,
    EpisodeOver,
    Progress,
    StrategySettings,
)
from crash_coach_pkg.coach.strategies.by_rate import MovingRate


class CurriculumSettings(StrategySettings):
    alpha_max: float = Field(
        default=0.1,  # the authors' code
        ge=0,
        le=1,
        description="Crash rate at the end.",
        json_schema_extra={"unit": "1"},
    )
    fraction: float = Field(
        default=0.5,
        gt=0,
        le=1,
        description="Part of training, in environment steps, after which alpha_max is reached.",
        json_schema_extra={"unit": "1"},
    )
    episodes: int = Field(
        default=0,
        ge=0,
        le=1_000_000_000,
        description="Finished episodes after which alpha_max is reached, instead of fraction; 0: "
        "fraction counts.",
        json_schema_extra={"unit": "episodes"},
    )


class Curriculum(MovingRate[CurriculumSettings]):
    name: ClassVar[str] = "curriculum"
    summary: ClassVar[str] = "The crash rate grows with training, from 0 to alpha_max."
    Settings: ClassVar[type[StrategySettings]] = CurriculumSettings

    @property
    def highest(self) -> float:
        return self.settings.alpha_max

    def episode_over(self, over: EpisodeOver) -> None:
        self._follow(over.progress)

    def block_over(self, over: BlockOver) -> None:
        self._follow(over.progress)

    def take_over(self, rate: float, progress: Progress) -> None:
        self._follow(progress)

    def needs_length(self) -> str | None:
        if self.settings.episodes:
            return None
        return (
            "strategy curriculum: the length of training is unknown here; set curriculum.episodes, "
            "the finished episodes after which alpha_max is reached"
        )

    def _follow(self, progress: Progress) -> None:
        settings = self.settings
        if settings.episodes:
            # Where alpha_max is 0, any increment ends there.
            delta = settings.alpha_max / settings.episodes or 1.0
            self._rate = min(settings.alpha_max, delta * progress.episodes)
        elif progress.total_steps > 0:
            done = progress.env_steps / (settings.fraction * progress.total_steps)
            self._rate = settings.alpha_max * min(1.0, done)
        else:
            raise UserError(str(self.needs_length()))
