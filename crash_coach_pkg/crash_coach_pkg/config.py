"""The coach's settings: one schema for training, evaluation, the coach node and the docs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from crash_coach_pkg.plan import NEXT_STEP
from crash_coach_pkg.strategies import is_strategy, strategy_names
from sim_pkg.contract import UserError

CapRule = Literal["ceil", "floor", "authors"]


class CoachConfig(BaseModel):
    """Who crashes, how often and how.

    Precedence of the victims: strategy ``none`` crashes nobody; ``victims`` crash in every
    episode; ``crashed_exactly`` draws that many in every episode; otherwise the crash rate draws.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    strategy: str = Field(
        default="none",
        description="How the crash rate moves: none, fixed, curriculum, adaptive, or own.",
    )
    crash_rate: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="Crash rate alpha of strategy fixed, per robot and episode.",
    )
    crash_mode: Literal["mute", "stay", "random"] = Field(
        default="mute",
        description="What a crashed robot does: mute (no command arrives, it stays; stay is the "
        "paper's word for it) or random (a uniform available action each step).",
    )
    beta: float = Field(
        default=0.75,
        ge=0,
        le=1,
        description="Adaptive: success rate from which the crash rate rises.",
    )
    rho: float = Field(
        default=0.01,
        gt=0,
        le=1,
        description="Adaptive: share of the way moved per evaluation block.",
    )
    alpha_max: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="Highest crash rate; null: 0.1 for curriculum, 1.0 for adaptive.",
    )
    curriculum_fraction: float = Field(
        default=0.5,
        gt=0,
        le=1,
        description="Curriculum: part of training after which alpha_max is reached.",
    )
    curriculum_delta: float | None = Field(
        default=None,
        gt=0,
        le=1,
        description="Curriculum: increment per episode instead of curriculum_fraction; null: off.",
    )
    resample: bool = Field(
        default=True, description="Discard draws with more crashed robots than cap_rule allows."
    )
    cap_rule: CapRule = Field(
        default="ceil",
        description="Most robots of n that crash at rate a: ceil (n a), floor (n a, the paper), "
        "authors (n - round(n (1 - a)), the authors' code).",
    )
    max_crashed: int = Field(
        default=-1, ge=-1, description="Never crash more robots than this; -1: no further limit."
    )
    min_alive: int = Field(
        default=0, ge=0, description="Never leave fewer working robots than this."
    )
    victims: tuple[str, ...] = Field(
        default=(), description="Robots that crash in every episode; empty: victims are drawn."
    )
    crashed_exactly: int = Field(
        default=-1, ge=-1, description="Exactly this many random victims in every episode; -1: off."
    )
    start_step: int = Field(
        default=0, ge=0, lt=NEXT_STEP, description="First faulted control step of the episode."
    )
    duration_steps: int = Field(
        default=0,
        ge=0,
        lt=NEXT_STEP,
        description="Faulted control steps; 0: until the episode ends.",
    )

    @field_validator("strategy")
    @classmethod
    def _known_strategy(cls, name: str) -> str:
        if not is_strategy(name):
            known = ", ".join(strategy_names())
            raise ValueError(f"unknown coaching strategy {name!r}; one of: {known}")
        return name

    @field_validator("victims")
    @classmethod
    def _distinct_victims(cls, victims: tuple[str, ...]) -> tuple[str, ...]:
        twice = sorted({name for name in victims if victims.count(name) > 1})
        if twice:
            raise ValueError(f"victims names {', '.join(twice)} more than once")
        return victims

    @model_validator(mode="after")
    def _one_way_to_choose(self) -> Self:
        if self.victims and self.crashed_exactly >= 0:
            raise ValueError(
                f"victims {list(self.victims)} and crashed_exactly {self.crashed_exactly} "
                "contradict each other; use one of them"
            )
        return self


def check_robots(names: Sequence[str]) -> tuple[str, ...]:
    """A team's names. Raises UserError unless they are distinct and fit for topic names."""
    if not names:
        raise UserError("robots is empty; name at least one robot")
    for name in names:
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name):
            raise UserError(f"robot name {name!r} is not a valid ROS name (letters, digits, _)")
        if list(names).count(name) > 1:
            raise UserError(f"robots names {name!r} more than once")
    return tuple(names)


def check_team(config: CoachConfig, robots: tuple[str, ...]) -> None:
    """Holds the settings against a team.

    Raises:
        UserError: an unknown robot, or limits that this team cannot keep.
    """
    n = len(robots)
    unknown = [name for name in config.victims if name not in robots]
    if unknown:
        raise UserError(f"unknown robot {unknown[0]!r} in victims; one of: {', '.join(robots)}")
    if config.min_alive > n:
        raise UserError(f"min_alive {config.min_alive} is more than the team's {n} robots")
    if config.max_crashed > n:
        raise UserError(f"max_crashed {config.max_crashed} is more than the team's {n} robots")
    limit = most_crashed(config, n)
    for key, wanted in (
        ("victims", len(config.victims)),
        ("crashed_exactly", config.crashed_exactly),
    ):
        if wanted > limit:
            raise UserError(
                f"{key} asks for {wanted} crashed robots, but min_alive {config.min_alive} and "
                f"max_crashed {config.max_crashed} allow {limit} of {n}"
            )


def most_crashed(config: CoachConfig, n: int) -> int:
    """Robots of n that ``max_crashed`` and ``min_alive`` allow to crash together."""
    limit = n - config.min_alive
    return limit if config.max_crashed < 0 else min(limit, config.max_crashed)
