"""The coach node's parameters: one table for descriptors, checks and docs, without ROS.

Everything comes from the fields of ControlSettings and CoachConfig and the schemas of strategies
and fault modes; what a ROS parameter cannot say (null, an empty list) has a stated value instead.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from crash_coach_common.contract import UserError
from crash_coach_pkg.coach.config import FURTHEST_M, HIGHEST_RETURN, CoachConfig
from crash_coach_pkg.coach.draws import check_team
from crash_coach_pkg.coach.live_coach import ControlSettings
from crash_coach_pkg.coach.strategies import find_strategy, make_strategy, strategy_names
from crash_coach_pkg.coach.strategies.base import Candidates
from crash_coach_pkg.faults import SYNONYMS, check_parameters, fault_mode, mode_names
from crash_coach_pkg.team import TeamSpec

Value = bool | int | float | str | Sequence[str] | Sequence[float]
NOBODY = "none"
NO_RETURN = -HIGHEST_RETURN
UINT32_MAX = 2**32 - 1

# Modes' parameters have a ROS parameter each.
_NOT_IN_A_GRAPH = ("crash_parameters", "coach")


@dataclass(frozen=True)
class ParameterSpec:
    """``low`` and ``high`` are inclusive; None where there is no numeric range.

    ``choices``: of an enumerated one; empty: any value.
    """

    name: str
    default: Value
    description: str
    low: float | None = None
    high: float | None = None
    read_only: bool = False
    choices: tuple[str, ...] = ()


SPECIAL = {
    "strategy": ParameterSpec(
        "strategy",
        "fixed",
        "Who crashes in which episode: a strategy of docs/strategies.md, or an installed one.",
    ),
    "victims": ParameterSpec(
        "victims",
        (NOBODY,),
        "Robots that crash in every episode, whatever the strategy; ['none']: victims are the "
        "strategy's (an empty list has no type in ROS and is refused).",
    ),
    "return_above": ParameterSpec(
        "return_above",
        NO_RETURN,
        f"Fault the candidates once the episode's return exceeds this; {NO_RETURN:g}: off.",
        NO_RETURN,
        HIGHEST_RETURN,
    ),
}
START_SPECS = (
    ParameterSpec(
        "roles",
        (NOBODY,),
        "Role of each robot, in the order of robots; ['none']: nobody has one.",
        read_only=True,
    ),
    ParameterSpec(
        "dt_s",
        0.0,
        "Length of a control step, seconds; 0: unknown, then hazards are refused.",
        0.0,
        60.0,
        read_only=True,
    ),
    ParameterSpec(
        "fault_scenario",
        "",
        "A fault scenario, by name or path of its YAML file, that decides who crashes, when and "
        "how; empty: the parameters do.",
        read_only=True,
    ),
    ParameterSpec(
        "follow_sim",
        True,
        "Follow the episodes of /sim; false: one endless episode 0, for robots without our sim.",
        read_only=True,
    ),
)
"""Fixed at start."""
BESIDE_A_SCENARIO = frozenset(("enabled", "apply_at", "lease_s"))
"""What can still be set where a fault scenario decides the rest."""


def parameter_specs() -> tuple[ParameterSpec, ...]:
    """Every parameter of the coach node that can change while it runs."""
    return (*_specs(ControlSettings), *_specs(CoachConfig), *strategy_specs(), *mode_specs())


def strategy_specs() -> Iterator[ParameterSpec]:
    """``<strategy>.<name>`` for each setting of each known strategy."""
    for name in strategy_names():
        yield from _owned_specs("strategy", name, find_strategy(name).Settings)


def mode_specs() -> Iterator[ParameterSpec]:
    """``<mode>.<name>`` for each parameter of each known mode."""
    for mode in mode_names():
        yield from _owned_specs("crash_mode", mode, fault_mode(mode).Parameters)


def _owned_specs(what: str, owner: str, model: type[BaseModel]) -> Iterator[ParameterSpec]:
    for name, field in model.model_fields.items():
        low, high = _bounds(field)
        unit = unit_of(field)
        text = f"{what} {owner}: {field.description}" + (f" [{unit}]" if unit != "1" else "")
        # ROS knows a type by the default.
        default = float(field.default) if field.annotation is float else field.default
        yield ParameterSpec(f"{owner}.{name}", default, text, low, high)


def unit_of(field: FieldInfo) -> str:
    """Of a mode's parameter or a strategy's setting; "1" where it has none."""
    extra = field.json_schema_extra
    return str(extra.get("unit", "1")) if isinstance(extra, dict) else "1"


def _specs(model: type[BaseModel]) -> Iterator[ParameterSpec]:
    for name, field in model.model_fields.items():
        if name in SPECIAL:
            yield replace(SPECIAL[name], choices=_choices(name, field))
        elif name not in _NOT_IN_A_GRAPH:
            low, high = _bounds(field)
            text = str(field.description)
            choices = _choices(name, field)
            yield ParameterSpec(name, field.default, text, low, high, choices=choices)


def _choices(name: str, field: FieldInfo) -> tuple[str, ...]:
    """What an enumerated parameter takes, with what other packages have installed."""
    installed = {"crash_mode": (*mode_names(), *SYNONYMS), "strategy": strategy_names()}
    if name in installed:
        return installed[name]
    literal = get_origin(field.annotation) is Literal
    return tuple(str(word) for word in get_args(field.annotation)) if literal else ()


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


def build_team(values: Mapping[str, Value], robots: tuple[str, ...]) -> TeamSpec:
    """The team from the values of START_SPECS. Raises UserError as TeamSpec."""
    roles = _names("roles", values["roles"])
    dt_s = _number(values["dt_s"])
    return TeamSpec(robots, roles, dt_s or None)


def build_settings(values: Mapping[str, Value], team: TeamSpec) -> ControlSettings:
    """The whole configuration from a value for every parameter.

    Raises:
        UserError: naming the parameter, its value and what would be right.
    """
    return_above = _number(values["return_above"])
    coach: dict[str, Any] = {
        **{name: values[name] for name in CoachConfig.model_fields if name in values},
        "victims": _names("victims", values["victims"]),
        "return_above": None if return_above == NO_RETURN else return_above,
        "near_point_m": _point(values),
        "crash_parameters": _mode_parameters(values),
        **{name: _owned(values, name) for name in strategy_names()},
    }
    own: dict[str, Any] = {
        name: values[name] for name in ControlSettings.model_fields if name in values
    }
    try:
        config = CoachConfig(**coach)
        settings = ControlSettings(**own, coach=config)
    except ValidationError as error:
        raise UserError(_reasons(error)) from None
    check_team(config, team)
    check_length(config)
    return settings


def check_length(config: CoachConfig) -> None:
    """Raises UserError for a strategy that needs the length of training, which no graph knows."""
    strategy = make_strategy(config.strategy, config.settings, Candidates(1, 1))
    if reason := strategy.needs_length():
        raise UserError(reason)


def _owned(values: Mapping[str, Value], owner: str) -> dict[str, float]:
    """What a strategy or mode has among the values, by its own names."""
    start = f"{owner}."
    return {
        name.removeprefix(start): _number(value)
        for name, value in values.items()
        if name.startswith(start)
    }


def _mode_parameters(values: Mapping[str, Value]) -> dict[str, float]:
    """Those of the chosen mode. The others are checked too: choosing their mode must not fail."""
    by_mode = {mode: _owned(values, mode) for mode in mode_names()}
    for mode, parameters in by_mode.items():
        check_parameters(mode, parameters)
    chosen = str(values["crash_mode"])
    return by_mode.get(SYNONYMS.get(chosen, chosen), {})  # an unknown one is CoachConfig's to name


def _point(values: Mapping[str, Value]) -> tuple[float, ...]:
    """near_point_m, checked, and (0, 0) while it is off: it is set before the radius, or after."""
    value = values["near_point_m"]
    point = () if isinstance(value, str | bool | int | float) else tuple(map(_number, value))
    if len(point) != 2 or not all(abs(x) <= FURTHEST_M for x in point):
        raise UserError(
            f"near_point_m {list(point)}: x and y in metres, within {FURTHEST_M:g} of the origin"
        )
    return point if _number(values["near_radius_m"]) else (0.0, 0.0)


# When they change, the running episode need not be planned again.
NOT_IN_PLAN = frozenset(("apply_at", "lease_s", "block_episodes", "success_from"))


def counts_now(settings: ControlSettings, changed: Collection[str], endless: bool) -> bool:
    """Whether a change concerns the running episode; in an ``endless`` one there is no next."""
    owners = (fault_mode(settings.coach.crash_mode).name, settings.coach.strategy)
    of_plan = [
        name
        for name in changed
        if name not in NOT_IN_PLAN and ("." not in name or name.split(".")[0] in owners)
    ]
    return bool(of_plan) and (endless or settings.apply_at == "next_step")


WHOM = ("victims", "crashed_exactly", "hazard_rate_hz", "near_radius_m", "return_above")


def check_change(settings: ControlSettings, changed: Sequence[str]) -> None:
    """Raises UserError for a change that asks for victims while nobody can crash.

    A call that says itself that nobody shall crash, as a file of all parameters may, means it.
    """
    coach = settings.coach
    asked = [name for name in WHOM if name in changed]
    if not asked or not (coach.victims or coach.crashed_exactly > 0 or coach.triggered):
        return
    if not settings.enabled and "enabled" not in changed:
        raise UserError(
            f"{asked[0]} would have no effect: enabled is false (as /coach/clear_all leaves it); "
            "set enabled to true first, or in the same call"
        )
    if coach.crashes_nobody and "strategy" not in changed:
        raise UserError(
            f"{asked[0]} would have no effect: strategy is {coach.strategy}; set fixed, for one"
        )


def check_beside(scenario: str, changed: Sequence[str]) -> None:
    """Raises UserError for a change that a fault scenario leaves without effect."""
    known = {spec.name for spec in parameter_specs()}
    for name in changed:
        if scenario and name in known and name not in BESIDE_A_SCENARIO:
            raise UserError(
                f"{name} would have no effect: fault_scenario {scenario} decides who crashes, when "
                f"and how; only {', '.join(sorted(BESIDE_A_SCENARIO))} can be set"
            )


def _names(key: str, value: Value) -> tuple[str, ...]:
    """A list of names, of which ['none'] is the empty one."""
    if isinstance(value, str | bool | int | float) or not all(isinstance(n, str) for n in value):
        raise UserError(f"{key} {value!r} is not a list of names")
    names = tuple(str(name) for name in value)
    if NOBODY in names and len(names) > 1:
        raise UserError(f"{key} {list(names)}: {NOBODY!r} stands alone")
    return () if names == (NOBODY,) else names


def _number(value: object) -> float:
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
