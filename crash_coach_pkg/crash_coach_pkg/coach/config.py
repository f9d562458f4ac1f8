"""The coach's settings: one schema for training, evaluation, the coach node and the docs."""

from __future__ import annotations

import difflib
from typing import Annotated, Any, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from crash_coach_common.wrong_key import Misplaced
from crash_coach_pkg.coach.strategies import (
    check_settings,
    find_strategy,
    is_strategy,
    strategy_names,
)
from crash_coach_pkg.coach.strategies.base import StrategySettings
from crash_coach_pkg.coach.victims import CapRule
from crash_coach_pkg.faults import check_parameters, fault_mode
from crash_coach_pkg.plan import NEXT_STEP

FURTHEST_M = 1e6
HIGHEST_RETURN = 1e9
HIGHEST_HAZARD_HZ = 1000.0
Coordinate = Annotated[float, Field(ge=-FURTHEST_M, le=FURTHEST_M)]


class FaultConfig(BaseModel):
    """One fault: whom it concerns, when, and how.

    Whom: ``victims``, or ``crashed_exactly`` of the candidates, or every candidate; candidates are
    the robots of ``victim_role``, or all. When: from ``start_step`` on, for ``duration_steps``; or
    whenever from then on a hazard or condition strikes (one of them at most).
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    crash_mode: str = Field(
        default="mute",
        description="What happens to a crashed robot: a mode of docs/faults.md, such as mute (no "
        "command arrives, it stays; stay is the paper's word) or random (a uniform command).",
    )
    crash_parameters: dict[str, float] = Field(
        default_factory=dict, description="Parameters of crash_mode; the rest has its default."
    )
    victims: tuple[str, ...] = Field(
        default=(), description="Robots that crash in every episode; empty: victims are drawn."
    )
    victim_role: str = Field(
        default="", description="Draw among the robots of this role only; empty: among all."
    )
    crashed_exactly: int = Field(
        default=-1, ge=-1, description="Exactly this many random victims in every episode; -1: off."
    )
    start_step: int = Field(
        default=0, ge=0, lt=NEXT_STEP, description="First control step that can be faulted."
    )
    duration_steps: int = Field(
        default=0,
        ge=0,
        lt=NEXT_STEP,
        description="Faulted control steps; 0: until the episode ends.",
    )
    hazard_rate_hz: float = Field(
        default=0.0,
        ge=0,
        le=HIGHEST_HAZARD_HZ,
        description="Faults per second and candidate, at random steps, again after each recovery; "
        "0: off.",
    )
    near_point_m: tuple[Coordinate, Coordinate] = Field(
        default=(0.0, 0.0),
        description="Point x, y in the map frame, metres, that near_radius_m is about.",
    )
    near_radius_m: float = Field(
        default=0.0,
        ge=0,
        le=FURTHEST_M,
        description="Fault a candidate once it is this near to near_point_m, metres; 0: off.",
    )
    return_above: float | None = Field(
        default=None,
        gt=-HIGHEST_RETURN,
        le=HIGHEST_RETURN,
        description="Fault the candidates once the episode's return exceeds this; null: off.",
    )
    max_crashed: int = Field(
        default=-1, ge=-1, description="Never crash more robots than this; -1: no further limit."
    )
    min_alive: int = Field(
        default=0, ge=0, description="Never leave fewer working robots than this."
    )

    @property
    def triggered(self) -> bool:
        """Whether a hazard or a condition starts the fault."""
        return self.hazard_rate_hz > 0 or self.near_radius_m > 0 or self.return_above is not None

    @field_validator("crash_mode")
    @classmethod
    def _known_mode(cls, name: str) -> str:
        fault_mode(name)
        return name

    @field_validator("crash_parameters")
    @classmethod
    def _known_parameters(
        cls, parameters: dict[str, float], info: ValidationInfo
    ) -> dict[str, float]:
        if "crash_mode" in info.data:  # otherwise that is what is wrong
            check_parameters(info.data["crash_mode"], parameters)
        return parameters

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
        if self.victims and self.victim_role:
            raise ValueError(
                f"victims {list(self.victims)} and victim_role {self.victim_role!r} contradict "
                "each other; use one of them"
            )
        return self

    @model_validator(mode="after")
    def _one_trigger(self) -> Self:
        given = {
            "hazard_rate_hz": self.hazard_rate_hz if self.hazard_rate_hz > 0 else None,
            "near_radius_m": self.near_radius_m if self.near_radius_m > 0 else None,
            "return_above": self.return_above,
        }
        asked = [f"{name} {value}" for name, value in given.items() if value is not None]
        if len(asked) > 1:
            raise ValueError(f"{' and '.join(asked)} contradict each other; use one of them")
        if any(self.near_point_m) and not self.near_radius_m:
            raise ValueError(
                f"near_point_m {list(self.near_point_m)} has no effect without near_radius_m"
            )
        return self


class CoachConfig(FaultConfig):
    """Who crashes, how often and how.

    Precedence of the victims: ``victims`` crash in every episode, under every strategy; strategy
    ``none`` crashes nobody else; ``crashed_exactly`` draws that many in every episode; otherwise
    the strategy plans. With a hazard or condition, these are whom it can strike.

    Every other key is a strategy's name and holds its settings, ``adaptive: {beta: 0.7}``. Those of
    the chosen one are ``settings``; the others' are checked, and left out: they count for nothing.
    """

    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False)

    strategy: str = Field(
        default="none",
        description="Who crashes in which episode: a strategy of docs/strategies.md, or your own.",
    )
    crash_rate: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="Crash rate alpha of strategy fixed, per robot and episode.",
    )
    resample: bool = Field(
        default=True, description="Discard draws with more crashed robots than cap_rule allows."
    )
    cap_rule: CapRule = Field(
        default="ceil",
        description="Most robots of n that crash at rate a: ceil (n a), floor (n a, the paper), "
        "authors (n - round(n (1 - a)), the authors' code).",
    )

    @model_validator(mode="before")
    @classmethod
    def _settings_of_strategies(cls, values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        own = {key: value for key, value in values.items() if key in cls.model_fields}
        chosen = own.get("strategy", cls.model_fields["strategy"].default)
        sections: dict[Any, Any] = {}
        if isinstance(chosen, str) and is_strategy(chosen):
            sections[chosen] = {}
        sections |= {key: value for key, value in values.items() if key not in own}
        for name, section in sections.items():
            if not is_strategy(name):
                raise Misplaced((name,), _unknown_key(str(name), list(cls.model_fields)))
            if isinstance(section, StrategySettings):
                section = section.model_dump()
            if not isinstance(section, dict):
                raise Misplaced((name,), f"{name} = {section!r}: settings are needed, key by key")
            settings = check_settings(name, section)
            if name == chosen and type(settings).model_fields:
                own[name] = settings
        return own

    @field_validator("strategy")
    @classmethod
    def _known_strategy(cls, name: str) -> str:
        find_strategy(name)
        return name

    @property
    def settings(self) -> StrategySettings:
        """Of the chosen strategy."""
        given: StrategySettings | None = (self.model_extra or {}).get(self.strategy)
        return given if given is not None else find_strategy(self.strategy).Settings()

    @property
    def crashes_nobody(self) -> bool:
        """Whether nobody ever crashes, whatever else is set."""
        return not self.victims and not find_strategy(self.strategy).crashes


def _unknown_key(key: str, fields: list[str]) -> str:
    """What to say of a key that is neither a setting of the coach nor a strategy."""
    meant: dict[str, list[str]] = {name: [name] for name in (*fields, *strategy_names())}
    for strategy in strategy_names():
        for setting in find_strategy(strategy).Settings.model_fields:
            full = f"{strategy}.{setting}"
            meant.setdefault(setting, []).append(full)
            meant[f"{strategy}_{setting}"] = [full]
    close = difflib.get_close_matches(key, meant, n=1)
    hint = f" (did you mean {' or '.join(map(repr, meant[close[0]]))}?)" if close else ""
    known = ", ".join(sorted([*fields, *strategy_names()]))
    return f"unknown key {key!r} of the coach{hint}; known keys: {known}"
