"""One message per step instead of one per robot: the commands of a step, until all are decided."""

from __future__ import annotations

from crash_coach_common.team_cdr import RobotMessage

Key = tuple[int, int]  # (episode, step)


class StepCommands:
    """Keeps what lock-step decides of robots one by one, until the step is whole.

    Whole is a step of as many robots as the one before: a sim may have fewer than the gate. Where
    one stays away the others' commands stay here; the sim asks again, and the gate repeats itself,
    which goes past this.
    """

    def __init__(self, n_robots: int) -> None:
        self._expected = n_robots
        self._key: Key = (-1, -1)
        self._decided: set[int] = set()
        self._kept: list[RobotMessage] = []

    def decided(self, key: Key, robot: int, command: bytes | None) -> list[RobotMessage]:
        """Takes a robot's decision, None where its command is withheld; returns what goes out now.

        A newer step lets go of what was kept of the one before.
        """
        out: list[RobotMessage] = []
        if key != self._key:
            out = self._kept
            if self._decided:
                self._expected = len(self._decided)
            self._key, self._decided, self._kept = key, set(), []
        self._decided.add(robot)
        if command is not None:
            self._kept.append((robot, command))
        if len(self._decided) >= self._expected:
            out, self._kept = out + self._kept, []
        return out
