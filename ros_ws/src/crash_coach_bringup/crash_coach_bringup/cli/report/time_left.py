"""How far a number of like pieces of work is, and how long the rest will take."""

from __future__ import annotations

import time
from collections.abc import Callable


class TimeLeft:
    """Counts ``total`` pieces; the time left is that of the pieces so far, on average."""

    def __init__(self, total: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._total = total
        self._clock = clock
        self._began = clock()
        self._begun = 0

    def next(self) -> str:
        """To be called as a piece begins: '[3/40, 5 min left]'; without an estimate the first."""
        done, self._begun = self._begun, self._begun + 1
        if not done:
            return f"[1/{self._total}]"
        left_s = (self._clock() - self._began) / done * (self._total - done)
        return f"[{self._begun}/{self._total}, {_duration(left_s)} left]"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 90 * 60 else f"{seconds / 3600:.1f} h"
