"""Schemas of numbers as plain data: for ROS descriptors, documentation and checks."""

from __future__ import annotations

from typing import NamedTuple

from pydantic import BaseModel

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
    return number_fields(f"fault mode {mode.name!r}: parameter", mode.Parameters)


def number_fields(what: str, model: type[BaseModel]) -> tuple[ParameterInfo, ...]:
    """The fields of ``model``, each of which errors call a ``what``.

    Raises:
        ValueError: a field that is not a number, or lacks default, range, unit or description.
    """
    properties = model.model_json_schema().get("properties", {})
    return tuple(_info(f"{what} {name!r}", name, field) for name, field in properties.items())


def _info(place: str, name: str, field: dict[str, object]) -> ParameterInfo:
    kind = field.get("type")
    if kind not in ("integer", "number"):
        raise ValueError(f"{place} must be an int or a float, not {kind}")
    found = {"minimum": field.get("exclusiveMinimum"), **field}
    missing = [key for key in _KEYS if found.get(key) is None]
    if missing:
        raise ValueError(f"{place} has no {', '.join(missing)}")
    number = int if kind == "integer" else float
    default, low, high = (number(str(found[key])) for key in _KEYS[:3])
    unit, description = (str(found[key]) for key in _KEYS[3:])
    given = found.get("examples")
    example = number(str(given[0])) if isinstance(given, list) else default or number(high / 20)
    return ParameterInfo(name, kind == "integer", default, low, high, unit, description, example)
