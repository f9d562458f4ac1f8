"""Where a recorded episode stands: playing, paused, at which pace."""

from __future__ import annotations

from typing import Any


class Playback:
    """Over frames 0 to ``last``, ``dt_s`` apart. Plays from the beginning."""

    def __init__(self) -> None:
        self.last = 0
        self.playing = True
        self.speed = 1.0
        self._dt_s = 1.0
        self._position = 0.0

    @property
    def frame(self) -> int:
        return int(self._position)

    def load(self, last: int, dt_s: float, frame: int = 0) -> None:
        """Another episode; it stands at ``frame``, or at its end where it is shorter."""
        self.last, self._dt_s = last, dt_s
        self._position = float(min(frame, last))

    def advance(self, elapsed_s: float) -> None:
        """Plays on for so long, and stops at the end."""
        if self.playing:
            self._position += self.speed * elapsed_s / self._dt_s
            if self._position >= self.last:
                self._position = float(self.last)
                self.playing = False

    def play(self, on: bool) -> None:
        """From the beginning, where it stands at the end."""
        if on and self.frame == self.last:
            self._position = 0.0
        self.playing = on

    def seek(self, frame: int) -> None:
        """As far as there are frames."""
        self._position = float(max(0, min(frame, self.last)))

    def step(self, by: int) -> None:
        self.playing = False
        self.seek(self.frame + by)

    def value(self) -> dict[str, Any]:
        return {"playing": self.playing, "speed": self.speed, "last": self.last}
