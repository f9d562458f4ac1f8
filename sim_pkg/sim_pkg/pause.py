"""Pausing without ROS: which control steps may be made, and the time that stands meanwhile."""

from __future__ import annotations

from collections.abc import Callable


class Pause:
    """Args: ``step_s``: what a control step takes; ``clock``: a steady clock, in seconds.

    Ages of commands are told by ``now_s``: otherwise a pause that is longer than the robots' time
    limit would end with every robot lost, and nobody muted.
    """

    def __init__(self, step_s: float, clock: Callable[[], float]) -> None:
        self._step_s = step_s
        self._clock = clock
        self._stood_s = 0.0  # how long in pauses that are over, less the steps granted in them
        self._since_s: float | None = None  # on the clock; None: not paused
        self._permits = 0

    @property
    def on(self) -> bool:
        return self._since_s is not None

    def now_s(self) -> float:
        """Goes on while not paused, and by ``step_s`` for every step granted in a pause."""
        now_s = self._clock() if self._since_s is None else self._since_s
        return now_s - self._stood_s

    def set(self, on: bool) -> None:
        """Pauses or goes on; steps granted before and not made yet are forgotten."""
        self.forget()
        if on and self._since_s is None:
            self._since_s = self._clock()
        elif not on and self._since_s is not None:
            self._stood_s += self._clock() - self._since_s
            self._since_s = None

    def grant(self) -> None:
        """One step may be made while paused."""
        self._permits += 1

    def forget(self) -> None:
        """Steps granted before and not made yet are not made."""
        self._permits = 0

    def may_step(self) -> bool:
        """Call before every control step: not paused, or one was granted (and is now used up)."""
        if self._since_s is None:
            return True
        if self._permits == 0:
            return False
        self._permits -= 1
        self._stood_s -= self._step_s
        return True
