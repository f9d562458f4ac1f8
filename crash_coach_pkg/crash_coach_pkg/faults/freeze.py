"""Freeze: the last command repeats."""

from __future__ import annotations

from typing import ClassVar

from crash_coach_pkg.faults.base import C, CommandFault, Need, Step, Tools


class Freeze(CommandFault[C]):
    name: ClassVar[str] = "freeze"
    code: ClassVar[int] = 3
    summary: ClassVar[str] = (
        "What the controller wanted last before the fault repeats; nothing arrives where that was "
        "nothing, or where it is not available any more."
    )
    needs: ClassVar[frozenset[Need]] = frozenset(("availability",))

    def __init__(self, parameters: object) -> None:
        super().__init__(parameters)
        self._frozen: C | None = None

    def begin(self, wanted: C | None) -> None:
        # Not what was passed on: after a fault that may be what the fault before made of it.
        self._frozen = wanted

    def apply(self, step: Step, command: C, last: C | None, tools: Tools[C]) -> C | None:
        return self._frozen
