"""The session's teams and browser."""

from __future__ import annotations

from console_teams import browser, episodes, teams

__all__ = ["browser", "episodes", "teams"]
