"""Freeze: the last command repeats."""

from __future__ import annotations

from typing import ClassVar

from crash_coach_pkg.faults.base import C, CommandFault, Need, Step, Tools


class Freeze(CommandFault[C]):
    name: ClassVar[str] = "freeze"
    code: ClassVar[int] = 3
    summary: ClassVar[str] = (
        "The last command before the fault repeats; nothing arrives where there was none, or "
        "where it is not available any more."
    )
    needs: ClassVar[frozenset[Need]] = frozenset(("availability",))

    def __init__(self, parameters: object) -> None:
        super().__init__(parameters)
        self._frozen: C | None = None
        self._begun = False

    def apply(self, step: Step, command: C, last: C | None, tools: Tools[C]) -> C | None:
        if not self._begun:
            self._begun, self._frozen = True, last
        return self._frozen
