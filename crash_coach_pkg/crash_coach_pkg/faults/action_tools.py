"""What faults can do with a scenario's actions: the tools of crash_coach_pkg.faults.base."""

from __future__ import annotations

import numpy as np

from crash_coach_common.contract import BoolArray
from crash_coach_pkg.faults.base import Need, Vector
from crash_coach_pkg.faults.batch_faults import random_available

ACTION_OFFERS: frozenset[Need] = frozenset(("availability", "sampler", "worst"))

UNTOLD = -1
"""``Action.worst_action`` of a policy that does not tell."""


class ActionTools:
    """Args: ``available``: (A,), None: not known. ``worst``: the action, or UNTOLD."""

    def __init__(self, available: BoolArray | None, worst: int) -> None:
        self._available = available
        self._worst = worst

    def usable(self, command: int) -> bool:
        mask = self._available
        return mask is not None and 0 <= command < len(mask) and bool(mask[command])

    def sample(self, bits: int) -> int | None:
        if self._available is None:
            return None
        return int(random_available(np.array([bits], np.uint64), self._available[None, :])[0])

    def worst(self) -> int | None:
        return None if self._worst == UNTOLD else self._worst

    def vector(self, command: int) -> Vector:
        raise TypeError("an action is not a velocity")

    def with_vector(self, command: int, vector: Vector) -> int:
        raise TypeError("an action is not a velocity")
