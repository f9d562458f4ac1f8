"""A mode's parameters as plain data: for ROS descriptors, documentation and checks."""

from __future__ import annotations

from typing import NamedTuple

from crash_coach_pkg.faults.base import FaultMode

_KEYS = ("default", "minimum", "maximum", "unit", "description")


class ParameterInfo(NamedTuple):
    """One parameter; ``low``, ``high`` and ``example`` are allowed values."""

    name: str
    is_integer: bool
    default: float
    low: float
    high: float
    unit: str
    description: str
    example: float  # for documentation: one that does something, together with the others'


def parameters_of(mode: type[FaultMode]) -> tuple[ParameterInfo, ...]:
    """In the order of the schema.

    Raises:
        ValueError: a parameter that is not a number, or lacks default, range, unit or description.
    """
    properties = mode.Parameters.model_json_schema().get("properties", {})
    return tuple(_info(mode, name, field) for name, field in properties.items())


def _info(mode: type[FaultMode], name: str, field: dict[str, object]) -> ParameterInfo:
    place = f"fault mode {mode.name!r}: parameter {name!r}"
    kind = field.get("type")
    if kind not in ("integer", "number"):
        raise ValueError(f"{place} must be an int or a float, not {kind}")
    missing = [key for key in _KEYS if key not in field]
    if missing:
        raise ValueError(f"{place} has no {', '.join(missing)} (see FaultParameters)")
    number = int if kind == "integer" else float
    default, low, high = (number(str(field[key])) for key in _KEYS[:3])
    unit, description = (str(field[key]) for key in _KEYS[3:])
    given = field.get("examples")
    example = number(str(given[0])) if isinstance(given, list) else default or number(high / 20)
    return ParameterInfo(name, kind == "integer", default, low, high, unit, description, example)
