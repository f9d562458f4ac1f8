"""The generated parts of docs/faults.md: every mode, setting and expectation from its schema."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from crash_coach_bringup.cli.markdown import table
from crash_coach_bringup.cli.output import CliError
from crash_coach_pkg.coach.config import FaultConfig
from crash_coach_pkg.coach.expectations import Expectation
from crash_coach_pkg.coach.fault_scenario import FaultScenarioConfig
from crash_coach_pkg.faults import fault_mode, is_observation_mode, mode_names
from crash_coach_pkg.faults.schema import ParameterInfo, parameters_of

BLOCK = re.compile(r"(<!-- generated: (\w+) -->\n).*?(<!-- end -->)", flags=re.DOTALL)
COMMANDS = "`/<robot>/command_raw` → `/<robot>/command`"
OBSERVATIONS = "`/<robot>/observation` → `/<robot>/observation_seen`"
# Who knows no availability, as with velocities, takes every command for available.
NEEDS = {
    "sampler": "`Action`, `Twist` or `TwistStamped`",
    "worst": "a policy that fills `Action.worst_action`",
    "vector": "`Twist` or `TwistStamped`",
}
UNITS = {
    "start_step": "control step",
    "duration_steps": "control steps",
    "hazard_rate_hz": "1/s",
    "near_point_m": "m, map frame",
    "near_radius_m": "m",
    "return_above": "return",
    "crashed_exactly": "robots",
    "max_crashed": "robots",
    "min_alive": "robots",
}
SET_LINES = {
    "crash_mode": "mute",
    "victims": "\"['robot_1']\"",
    "victim_role": "robot",
    "crashed_exactly": "1",
    "start_step": "5",
    "duration_steps": "10",
    "hazard_rate_hz": "0.05",
    "near_point_m": '"[2.0, 2.0]"',
    "near_radius_m": "1.5",
    "return_above": "4.0",
    "max_crashed": "1",
    "min_alive": "1",
}
"""A value of each setting, as typed behind `ros2 param set /coach NAME`."""


def generated() -> dict[str, str]:
    """The blocks by name, in the order of the page."""
    return {
        "modes": modes(),
        "settings": settings(),
        "file": table(
            ("key", "default", "meaning"),
            ((f"`{n}`", default(f), f.description) for n, f in fields(FaultScenarioConfig)),
        ),
        "expectations": expectations(),
    }


def update(page: str) -> str:
    """``page`` with every block as it should be.

    Raises:
        CliError: a block is missing, unknown, or there twice.
    """
    blocks = generated()
    found = [match.group(2) for match in BLOCK.finditer(page)]
    if sorted(found) != sorted(blocks):
        raise CliError(
            f"generated blocks {', '.join(found) or 'none'}; there have to be, once each: "
            + ", ".join(blocks)
        )
    return BLOCK.sub(lambda m: f"{m.group(1)}{blocks[m.group(2)]}\n{m.group(3)}", page)


def modes() -> str:
    """A section for every mode, those of installed packages included."""
    return "\n\n".join(_mode(name) for name in mode_names())


def _mode(name: str) -> str:
    mode = fault_mode(name)
    observes = is_observation_mode(name)
    lines = [f"### `{name}`", "", mode.summary, ""]
    lines += [f"- **Topic**: {OBSERVATIONS if observes else COMMANDS}; code {mode.code}"]
    if observes:
        lines += ["- **Needs**: a gate with `relay_observations`"]
    else:
        lines += [f"- **Needs**: {NEEDS[need]}" for need in sorted(mode.needs) if need in NEEDS]
    parameters = parameters_of(mode)
    if parameters:
        rows = [
            (f"`{p.name}`", p.unit, f"{p.low:g}..{p.high:g}", f"{p.default:g}", p.description)
            for p in parameters
        ]
        lines += ["", table(("parameter", "unit", "range", "default", "meaning"), rows)]
    commands = [f"ros2 param set /coach {n} {v}" for n, v in _set(name, parameters)]
    return "\n".join([*lines, "", "```bash", *commands, "```"])


def _set(mode: str, parameters: Iterable[ParameterInfo]) -> list[tuple[str, str]]:
    values = []
    for p in parameters:
        value = int(p.example) if p.is_integer else float(p.example)
        values.append((f"{mode}.{p.name}", str(value)))
    return [*values, ("crash_mode", mode)]


def settings() -> str:
    """Who and when, with a `ros2 param set` line each."""
    rows = []
    for name, field in fields(FaultConfig):
        typed = f"`ros2 param set /coach {name} {SET_LINES[name]}`" if name in SET_LINES else ""
        cells = (UNITS.get(name, ""), limits(field), default(field), field.description, typed)
        rows.append((f"`{name}`", *cells))
    return table(("setting", "unit", "range", "default", "meaning", "as a ROS parameter"), rows)


def expectations() -> str:
    rows = []
    for name, field in fields(Expectation):
        kind = next(t for t in field.annotation.__args__ if issubclass(t, BaseModel))
        about = inspect.getdoc(kind)
        for key, value in fields(kind):
            cells = (limits(value), default(value), value.description)
            rows.append((f"`{name}`", about, f"`{key}`", *cells))
            about = ""
    columns = ("expectation", "what is measured", "key", "range", "default", "meaning")
    return table(columns, rows)


def fields(model: type[BaseModel]) -> Iterable[tuple[str, Any]]:
    return model.model_fields.items()


def limits(field: FieldInfo) -> str:
    """'0..1', 'at least 0', or nothing; an integer's open end is shown as the last value."""
    low: Any = None
    high: Any = None
    for limit in field.metadata:
        low = getattr(limit, "ge", getattr(limit, "gt", low))
        high = getattr(limit, "le", limit.lt - 1 if hasattr(limit, "lt") else high)
    if low is not None and high is not None:
        return f"{low:.10g}..{high:.10g}"
    return "" if low is None else f"at least {low:g}"


def default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if value is None:
        return "null"
    if isinstance(value, tuple):
        return f"`{list(value)}`"
    return f"`{value!r}`" if isinstance(value, str | dict) else f"{value:g}"
