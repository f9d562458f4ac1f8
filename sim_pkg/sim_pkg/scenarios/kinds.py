"""The kinds of scenario by the ``kind`` key of their YAML."""

from __future__ import annotations

from typing import Any

from crash_coach_common.plugins import Plugins
from crash_coach_common.strict_yaml import StrictModel
from sim_pkg.scenarios import buttons, coverage, transport
from sim_pkg.scenarios.base import Kind
from sim_pkg.scenarios.skirmish import rules as skirmish

ENTRY_POINT_GROUP = "crash_coach.scenarios"


def _check(name: str, kind: Any) -> None:
    if not isinstance(kind, Kind):
        raise ValueError(f"{kind!r} is no sim_pkg.scenarios.base.Kind")
    if not issubclass(kind.config, StrictModel) or "kind" not in kind.config.model_fields:
        raise ValueError(f"{kind.config!r} is no StrictModel with a key kind")


KINDS: Plugins[Kind] = Plugins(
    ENTRY_POINT_GROUP,
    {
        "buttons": buttons.KIND,
        "coverage": coverage.KIND,
        "skirmish": skirmish.KIND,
        "transport": transport.KIND,
    },
    _check,
)
"""Ours, and those of installed packages: an entry point ``kind = module:KIND``."""
