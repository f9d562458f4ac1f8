"""How teams are named: a folder, or `scripted:NAME`. Apart, for nodes without a simulator."""

from __future__ import annotations

from pathlib import Path

SCRIPTED = "scripted:"


def scripted_name(team: str | Path) -> str | None:
    """NAME of ``scripted:NAME``; None for a trained team."""
    text = str(team)
    return text.removeprefix(SCRIPTED) if text.startswith(SCRIPTED) else None
