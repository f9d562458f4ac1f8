"""The record of what faults did: the same from a run in one process and from /coach/events."""

from __future__ import annotations

from typing import Final, Literal, NamedTuple

EffectKind = Literal["ACTIVE", "CLEARED", "EFFECT"]

# Values of ``applied`` beside actions, as in FaultEvent.msg.
WITHHELD: Final = -1
OBSERVED: Final = -2
RELAYED: Final = -3

NO_ACTION: Final = -1
"""``intent`` and ``applied`` where there is no command."""


class EffectRow(NamedTuple):
    """One event about one robot, with the names and numbers that it has on the wire.

    Sorted rows compare: within a step the gate's events come in the order of the commands.
    """

    episode: int
    step: int
    kind: EffectKind
    robot: str
    mode: str
    entry: int
    intent: int = NO_ACTION  # action that the policy wanted, for EFFECT of a command
    applied: int = NO_ACTION  # action passed on, or WITHHELD, OBSERVED, RELAYED
