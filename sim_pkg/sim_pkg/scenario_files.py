"""The shipped scenarios, by name."""

from __future__ import annotations

from pathlib import Path

from crash_coach_common.strict_yaml import find_shipped, shipped_names

SCENARIOS_DIR = Path(__file__).parent / "configs" / "scenarios"


def scenario_names() -> tuple[str, ...]:
    """Names of the shipped scenarios, sorted; ``skirmish/3m`` for a file in a folder."""
    return shipped_names(SCENARIOS_DIR)


def find_scenario(scenario: str | Path) -> Path:
    """The file of a shipped scenario's name, or of a path.

    Raises:
        ConfigError: neither a known name nor an existing file.
    """
    return find_shipped("scenario", SCENARIOS_DIR, scenario)
