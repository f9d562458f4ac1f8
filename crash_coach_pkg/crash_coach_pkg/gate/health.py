"""How each robot's stream of commands is doing, without ROS: what gates say on /diagnostics."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple

_NEVER_S = float("-inf")


class RobotState(Enum):
    """Of a robot's commands as the gate sees them; the values are words for the operator."""

    OK = "ok"
    MUTED = "muted by plan"  # any fault in force; the report names it
    LOST = "lost: no command in time"


class Decided(NamedTuple):
    """The newest robot-step of a robot and the fault in force in it ('' without)."""

    mode: str = ""
    episode: int = 0
    step: int = 0


class Report(NamedTuple):
    """One robot's line: ``text`` for people, ``values`` for programs."""

    robot: int
    state: RobotState
    text: str
    values: tuple[tuple[str, str], ...]


class TeamHealth:
    """Args: ``cmd_timeout_s``: a robot that no command came from for so long is lost.

    Times are a steady clock's, in seconds. Where it is told of the sim's steps, only the time in
    which the sim goes on counts: while it is paused nobody is asked, so nobody is silent.
    """

    def __init__(self, n_robots: int, cmd_timeout_s: float) -> None:
        self._timeout_s = cmd_timeout_s
        self._heard_s = [_NEVER_S] * n_robots
        self._intruders: list[tuple[str, ...]] = [()] * n_robots
        self._gap_s = cmd_timeout_s / 2  # between two steps; what is longer does not count
        self._moved_s: float | None = None  # None: nobody tells of a sim
        self._stood_s = 0.0

    def sim_moved(self, now_s: float) -> None:
        """The sim has made a step."""
        if self._moved_s is not None:
            self._stood_s += max(0.0, now_s - self._moved_s - self._gap_s)
        self._moved_s = now_s

    def _counted_s(self, now_s: float) -> float:
        if self._moved_s is None:
            return now_s
        return min(now_s, self._moved_s + self._gap_s) - self._stood_s

    def heard(self, robot: int, now_s: float) -> None:
        """A command of ``robot`` came, whatever became of it."""
        self._heard_s[robot] = self._counted_s(now_s)

    def all_heard(self, now_s: float) -> None:
        """A command of every robot came."""
        self._heard_s = [self._counted_s(now_s)] * len(self._heard_s)

    def intruders(self, robot: int, who: tuple[str, ...]) -> None:
        """Who else publishes on the robot's command topic now; empty: nobody."""
        self._intruders[robot] = who

    def state(self, robot: int, mode: str, now_s: float) -> RobotState:
        """A robot whose commands stay away is lost even where a plan mutes it."""
        if self._counted_s(now_s) - self._heard_s[robot] >= self._timeout_s:
            return RobotState.LOST
        return RobotState.MUTED if mode else RobotState.OK

    def reports(self, decided: Sequence[Decided], now_s: float) -> list[Report]:
        """One for each robot, in order."""
        return [self._report(robot, at, now_s) for robot, at in enumerate(decided)]

    def _report(self, robot: int, at: Decided, now_s: float) -> Report:
        state = self.state(robot, at.mode, now_s)
        text = f"{state.value} ({at.mode})" if state is RobotState.MUTED else state.value
        if self._moved_s is not None and now_s - self._moved_s >= self._timeout_s:
            text += "; the sim stands still"
        age_s = self._counted_s(now_s) - self._heard_s[robot]
        values = [
            ("state", state.name.lower()),
            ("mode", at.mode),
            ("episode", str(at.episode)),
            ("step", str(at.step)),
            ("command_age_s", "never" if age_s == float("inf") else f"{age_s:.3f}"),
        ]
        who = self._intruders[robot]
        if who:
            text += f"; somebody else publishes on its command topic: {', '.join(who)}"
            values.append(("intruders", ", ".join(who)))
        return Report(robot, state, text, tuple(values))
