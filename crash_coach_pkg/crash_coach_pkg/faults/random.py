"""Random: a uniform command instead of the policy's."""

from __future__ import annotations

from typing import ClassVar

from crash_coach_pkg.faults.base import C, CommandFault, Need, Step, Tools

_STREAM = 0  # the batched fast path (crash_coach_pkg.faults.batch_faults) draws from the same


class Random(CommandFault[C]):
    name: ClassVar[str] = "random"
    code: ClassVar[int] = 2
    draws: ClassVar[bool] = True
    summary: ClassVar[str] = (
        "A uniform command instead: an available action, or a velocity within the gate's limits."
    )
    needs: ClassVar[frozenset[Need]] = frozenset(("availability", "sampler"))

    def apply(self, step: Step, command: C, last: C | None, tools: Tools[C]) -> C | None:
        return tools.sample(step.bits(_STREAM))
