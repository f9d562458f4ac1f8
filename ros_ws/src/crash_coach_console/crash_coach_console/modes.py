"""Every fault mode as a page needs it for its form: name, what it does, parameters with ranges."""

from __future__ import annotations

from typing import Any

from crash_coach_pkg.faults import fault_mode, is_observation_mode, mode_names
from crash_coach_pkg.faults.schema import parameters_of


def modes_value() -> list[dict[str, Any]]:
    """JSON values, installed modes included, in order of their codes."""
    return [
        {
            "name": name,
            "summary": fault_mode(name).summary,
            "observation": is_observation_mode(name),
            "parameters": [info._asdict() for info in parameters_of(fault_mode(name))],
        }
        for name in mode_names()
    ]
