"""Mute: no command arrives."""

from __future__ import annotations

from typing import ClassVar

from crash_coach_pkg.faults.base import C, CommandFault, Step, Tools


class Mute(CommandFault[C]):
    name: ClassVar[str] = "mute"
    code: ClassVar[int] = 1
    summary: ClassVar[str] = "No command arrives: the robot stays (the paper's word is `stay`)."

    def apply(self, step: Step, command: C, last: C | None, tools: Tools[C]) -> C | None:
        return None
