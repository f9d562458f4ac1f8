"""Adversarial: the worst that the policy knows."""

from __future__ import annotations

from typing import ClassVar

from crash_coach_pkg.faults.base import C, CommandFault, Need, Step, Tools


class Adversarial(CommandFault[C]):
    name: ClassVar[str] = "adversarial"
    code: ClassVar[int] = 8
    summary: ClassVar[str] = (
        "Instead of each command the available action that the robot's own policy values least; "
        "nothing where the policy does not tell (Action only)."
    )
    needs: ClassVar[frozenset[Need]] = frozenset(("worst",))

    def apply(self, step: Step, command: C, last: C | None, tools: Tools[C]) -> C | None:
        return tools.worst()
