"""What goes into the gate's core and what comes out of it."""

from __future__ import annotations

from typing import Any, NamedTuple

from crash_coach_common.contract import BoolArray, FloatArray
from crash_coach_pkg.faults.action_tools import UNTOLD
from crash_coach_pkg.gate.plan_book import Event


class Command(NamedTuple):
    """What a policy wants. ``token`` is the caller's own (its message) and is handed back.

    A tuple, as Decision is: a frozen dataclass takes five times as long to make, and the gate
    makes both for every robot-step.
    """

    robot: int
    episode: int
    step: int
    action: int
    worst: int = UNTOLD  # the available action that the policy values least
    token: Any = None

    @property
    def key(self) -> tuple[int, int]:
        return (self.episode, self.step)


class Decision(NamedTuple):
    """What the robot gets: ``applied``, or no command where that is WITHHELD."""

    command: Command
    mode: str  # of the fault in force; '' without
    entry: int
    applied: int
    revision: int
    repeated: bool = False
    observation: bool = False  # the fault is one of the robot's observation: no EFFECT of its own


class Sight(NamedTuple):
    """A robot's observation: features (O,) float32, available (A,) bool, the caller's token."""

    robot: int
    episode: int
    step: int
    features: FloatArray
    available: BoolArray
    token: Any = None

    @property
    def key(self) -> tuple[int, int]:
        return (self.episode, self.step)


class Seen(NamedTuple):
    """What the robot's policy sees: ``features`` instead of the sight's own; None: untouched."""

    sight: Sight
    features: FloatArray | None


Outputs = tuple[Decision | Seen | Event, ...]
