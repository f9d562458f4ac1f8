"""Fault scenarios with every mode that actions can have, for tests that compare whole runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from crash_coach_pkg.faults import mode_names, unmet_needs
from crash_coach_pkg.faults.action_tools import ACTION_OFFERS

SCENARIO = "coverage"
ROBOTS = 4
MODES = tuple(name for name in mode_names() if unmet_needs(name, ACTION_OFFERS) is None)
PARAMETERS: dict[str, dict[str, float]] = {
    "delay": {"steps": 2},
    "drop": {"probability": 0.4, "to_bad": 0.3, "to_good": 0.5},
    "noise": {"stddev": 0.3},
}
STEPS_APART = 8
TRIGGERS = ("start", "hazard", "near", "return")


def when(trigger: str, first: int) -> dict[str, Any]:
    """From step ``first`` on. The return of a team that achieves nothing falls by 0.05 a step."""
    lasts = {"start_step": first, "duration_steps": STEPS_APART - 1}
    match trigger:
        case "hazard":
            return {"hazard_rate_hz": 0.2, "duration_steps": 3}
        case "near":
            return {**lasts, "near_point_m": [5.0, 6.0], "near_radius_m": 2.0}
        case "return":
            return {**lasts, "return_above": -0.05 * first - 0.02}
    return lasts


def entry(mode: str, robot: int, **of_time: Any) -> dict[str, Any]:
    return {
        "crash_mode": mode,
        "crash_parameters": PARAMETERS.get(mode, {}),
        "victims": [f"robot_{robot % ROBOTS + 1}"],
        **of_time,
    }


def one_after_the_other() -> list[dict[str, Any]]:
    """Every mode for some steps, overlapping with the next ones on other robots and the same."""
    return [
        entry(mode, i // 2, start_step=2 + 7 * i, duration_steps=11) for i, mode in enumerate(MODES)
    ]


def with_triggers(*triggers: str) -> list[dict[str, Any]]:
    """Every mode, begun by the triggers in turn."""
    return [
        entry(mode, i, **when(triggers[i % len(triggers)], STEPS_APART * i))
        for i, mode in enumerate(MODES)
    ]


def write(path: Path, faults: list[dict[str, Any]]) -> Path:
    path.write_text(yaml.safe_dump({"description": path.stem, "faults": faults}))
    return path
