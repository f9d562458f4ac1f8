"""The coach node's parameters: one table for descriptors, checks and docs, without ROS.

Everything comes from the fields of ControlSettings and CoachConfig; what a ROS parameter cannot
say (null, an empty list) has a stated value instead.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from crash_coach_pkg.config import CoachConfig, check_team
from crash_coach_pkg.control import ControlSettings
from crash_coach_pkg.strategies import ADAPTIVE_ALPHA_MAX, CURRICULUM_ALPHA_MAX
from sim_pkg.contract import UserError

Value = bool | int | float | str | Sequence[str]
NOBODY = "none"
NO_CEILING = -1.0
UINT32_MAX = 2**32 - 1

# Fraction and delta need the length of training; a graph has curriculum_episodes instead.
_NOT_IN_A_GRAPH = ("curriculum_fraction", "curriculum_delta")


@dataclass(frozen=True)
class ParameterSpec:
    """``low`` and ``high`` are inclusive; None where there is no numeric range."""

    name: str
    default: Value
    description: str
    low: float | None = None
    high: float | None = None


SPECIAL = {
    "strategy": ParameterSpec(
        "strategy",
        "fixed",
        "How the crash rate moves: none, fixed, curriculum, adaptive, or an installed one.",
    ),
    "victims": ParameterSpec(
        "victims",
        (NOBODY,),
        "Robots that crash in every episode; ['none']: victims are drawn by crash_rate (an empty "
        "list has no type in ROS and is refused).",
    ),
    "alpha_max": ParameterSpec(
        "alpha_max",
        NO_CEILING,
        f"Highest crash rate; -1: {CURRICULUM_ALPHA_MAX} for curriculum, {ADAPTIVE_ALPHA_MAX} for "
        "adaptive.",
        -1.0,
        1.0,
    ),
}
CURRICULUM_EPISODES = ParameterSpec(
    "curriculum_episodes",
    1000,
    "Curriculum: finished episodes after which alpha_max is reached.",
    1,
    1_000_000_000,
)


def parameter_specs() -> tuple[ParameterSpec, ...]:
    """Every parameter of the coach node but ``robots``."""
    return (*_specs(ControlSettings), *_specs(CoachConfig), CURRICULUM_EPISODES)


def _specs(model: type[BaseModel]) -> Iterator[ParameterSpec]:
    for name, field in model.model_fields.items():
        if name in SPECIAL:
            yield SPECIAL[name]
        elif name != "coach" and name not in _NOT_IN_A_GRAPH:
            low, high = _bounds(field)
            yield ParameterSpec(name, field.default, str(field.description), low, high)


def _bounds(field: FieldInfo) -> tuple[float | None, float | None]:
    """The range in ROS' terms: inclusive, so an open end is left to the check afterwards."""
    low: float | None = None
    high: float | None = None
    for limit in field.metadata:
        low = getattr(limit, "ge", getattr(limit, "gt", low))
        if hasattr(limit, "lt"):
            high = limit.lt - 1
        high = getattr(limit, "le", high)
    if isinstance(field.default, int) and low is not None and high is None:
        high = UINT32_MAX
    return low, high


def build_settings(values: Mapping[str, Value], robots: tuple[str, ...]) -> ControlSettings:
    """The whole configuration from a value for every parameter.

    Raises:
        UserError: naming the parameter, its value and what would be right.
    """
    coach: dict[str, Any] = {
        name: values[name] for name in CoachConfig.model_fields if name in values
    }
    victims = list(_strings(values["victims"]))
    if NOBODY in victims and len(victims) > 1:
        raise UserError(f"victims {victims}: {NOBODY!r} stands alone")
    coach["victims"] = () if victims == [NOBODY] else tuple(victims)
    alpha_max = _number(values["alpha_max"])
    if alpha_max != NO_CEILING and alpha_max < 0:
        raise UserError(f"alpha_max {alpha_max}: 0 to 1, or -1 for the strategy's own")
    own: dict[str, Any] = {
        name: values[name] for name in ControlSettings.model_fields if name in values
    }
    ceiling = CURRICULUM_ALPHA_MAX if alpha_max == NO_CEILING else alpha_max
    nullable = {
        "alpha_max": None if alpha_max == NO_CEILING else alpha_max,
        "curriculum_delta": ceiling / _number(values["curriculum_episodes"]) or None,
    }
    try:
        config = CoachConfig(**{**coach, **nullable})
        settings = ControlSettings(**own, coach=config)
    except ValidationError as error:
        raise UserError(_reasons(error)) from None
    check_team(config, robots)
    return settings


def check_change(settings: ControlSettings, changed: Sequence[str]) -> None:
    """Raises UserError for a change that asks for victims while nobody can crash."""
    asked = [name for name in ("victims", "crashed_exactly") if name in changed]
    if not asked or not (settings.coach.victims or settings.coach.crashed_exactly > 0):
        return
    if not settings.enabled:
        raise UserError(
            f"{asked[0]} would have no effect: enabled is false (as /coach/clear_all leaves it); "
            "set enabled to true first, or in the same call"
        )
    if settings.coach.strategy == "none":
        raise UserError(f"{asked[0]} would have no effect: strategy is none; set fixed, for one")


def _strings(value: Value) -> Sequence[str]:
    if isinstance(value, str | bool | int | float):
        raise UserError(f"victims {value!r} is not a list of robot names")
    return value


def _number(value: Value) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UserError(f"{value!r} is not a number")
    return float(value)


def _reasons(error: ValidationError) -> str:
    reasons = []
    for detail in error.errors():
        where = ".".join(str(part) for part in detail["loc"])
        text = detail["msg"].removeprefix("Value error, ")
        reasons.append(f"{where} {detail['input']!r}: {text}" if where else text)
    return "; ".join(reasons)
