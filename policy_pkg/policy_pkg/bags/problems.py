"""What is wrong with a recording, one clear line each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from crash_coach_common.contract import UserError


class Severity(Enum):
    """INCOMPLETE: something is missing, as at the end of any recording that was stopped.
    DAMAGED: what is there is wrong or contradicts itself."""

    INCOMPLETE = "incomplete"
    DAMAGED = "damaged"


@dataclass(frozen=True)
class Problem:
    """Where (file, or bag and episode) and what. Nothing of it was used."""

    place: str
    text: str
    severity: Severity = Severity.DAMAGED

    def __str__(self) -> str:
        return f"{self.place}: {self.text}"


Report = Callable[[Problem], None]


class BagError(UserError):
    """A recording that cannot be used at all, or a problem where none is accepted."""


def refuse(problem: Problem) -> None:
    """A Report that accepts no problem. Raises BagError."""
    raise BagError(str(problem))
