"""Steps of equal length on whichever clock counts, without ROS: they may stand, never go back."""

from __future__ import annotations

_NS_PER_S = 1_000_000_000


class StepClock:
    """Step 0 begins with the first reading; each is ``dt_s`` long.

    A clock that stands still (a paused simulator) holds the step. One that jumps back (a simulator
    that is started again), or makes way for another, costs no step and adds none.
    """

    def __init__(self, dt_s: float) -> None:
        self._dt_ns = round(dt_s * _NS_PER_S)
        self._elapsed_ns = 0
        self._read: tuple[str, int] | None = None

    def step(self, source: str, time_ns: int) -> int:
        """The step at a reading of the clock called ``source``."""
        if self._read is not None and self._read[0] == source:
            self._elapsed_ns += max(0, time_ns - self._read[1])
        self._read = source, time_ns
        return self._elapsed_ns // self._dt_ns
