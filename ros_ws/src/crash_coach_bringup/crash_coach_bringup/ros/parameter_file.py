"""A ROS parameter file (``--params-file``) for a graph's nodes: read before they start.

Its values win over those that the graph is started with, as rcl reads them after these. What the
graph itself is built from cannot be set there: nodes would not fit each other any more.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from crash_coach_common.contract import UserError
from crash_coach_common.strict_yaml import load_tree

PARAMETERS = "ros__parameters"
BUILT_FROM = frozenset({
    "robots", "robot", "roles", "dt_s", "scenario", "checkpoint", "live", "mode", "lockstep",
    "relay_observations", "observation_topic", "command_topic", "raw_topic", "command_type",
    "follow_sim", "fault_scenario", "use_sim_time", "success_from",
})  # fmt: skip


class ParameterFile:
    """Which values a file sets on which node; later entries count, as rcl reads it.

    Raises:
        UserError: it cannot be read, is no YAML, or no parameter file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.resolve()
        self._entries = list(self._walk(load_tree(path).values, ""))
        if not self._entries:
            raise UserError(
                f"{path}: no {PARAMETERS} in it; a parameter file has a node's name, then "
                f"{PARAMETERS}, then parameters"
            )

    def _walk(self, content: Any, node: str) -> Iterator[tuple[str, dict[str, Any]]]:
        if not isinstance(content, Mapping):
            where = f"under {node}" if node else "at the top"
            raise UserError(f"{self.path}: {where} a node's name with {PARAMETERS} is needed")
        for key, value in content.items():
            if key != PARAMETERS:
                yield from self._walk(value, f"{node}/{str(key).strip('/')}")
            elif not isinstance(value, Mapping):
                raise UserError(f"{self.path}: {PARAMETERS} of {node} are no parameters")
            else:
                yield node, dict(_flat(value, ""))

    def of(self, node: str) -> dict[str, Any]:
        """Values for ``node``, its name with namespace: /fleet_a/gate."""
        values: dict[str, Any] = {}
        for pattern, parameters in self._entries:
            if _regex(pattern).fullmatch(node):
                values |= parameters
        return values

    def check(self, node: str, given: Mapping[str, Any]) -> None:
        """Raises UserError where the file changes what the graph, of ``given``, is built from."""
        for name, value in self.of(node).items():
            if name in BUILT_FROM and name in given and value != given[name]:
                raise UserError(
                    f"{self.path}: {name} of {node} is {value!r}, but the graph is started with "
                    f"{given[name]!r}, which its nodes share: give it there, not in the file"
                )


def _flat(parameters: Mapping[Any, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    """Nested names, joined by dots."""
    for key, value in parameters.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _regex(pattern: str) -> re.Pattern[str]:
    """rcl's: ``*`` is one name, ``**`` any number of them."""
    parts = {"**": r"(/[^/]+)*", "*": "/[^/]+"}
    names = [part for part in pattern.split("/") if part]
    return re.compile("".join(parts.get(name, "/" + re.escape(name)) for name in names))
