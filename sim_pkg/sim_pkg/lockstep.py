"""Lock-step without ROS: which robots have been decided in a step, and what is still awaited."""

from __future__ import annotations

from enum import Enum

import numpy as np

from crash_coach_common.contract import BoolArray, IntArray

_FAULT_NONE = 0


class Health(Enum):
    """Why a robot did what it did in the last step."""

    OK = "ok"
    FAULTED = "command under a fault of the plan"
    MUTED = "muted by plan"
    LOST = "lost: no command in time"


class Decisions:
    """Collects exactly one decision per robot for one (episode, step): a command or a mute.

    Arrival order cannot matter: the first decision of a robot counts, and the actions are
    applied in robot order once all are there.

    Attributes:
        actions: (n,) int32; a muted robot's is its stay action.
        crashed: (n,) uint8; 1 where a fault made the action, or muted the robot.
        health: of each robot, by its newest decision.
        late: commands of each robot for a step that is over (or not open).
        duplicates: commands of each robot for the open step beyond the one that counts.
    """

    def __init__(self, robots: tuple[str, ...]) -> None:
        n = len(robots)
        self._robots = robots
        self._episode = self._step = -1
        self._decided = [True] * n
        self._missing = 0
        self._available: list[list[bool]] = []
        self._resends = 0
        self.actions: IntArray = np.zeros(n, dtype=np.int32)
        self.crashed = np.zeros(n, dtype=np.uint8)
        self.health = [Health.OK] * n
        self.late = [0] * n
        self.duplicates = [0] * n

    def open(self, episode: int, step: int, stay: IntArray, available: BoolArray) -> None:
        """Awaits decisions for a new step. stay: (n,); available: (n, A)."""
        n = len(self._robots)
        self._episode, self._step = episode, step
        self._decided = [False] * n
        self._missing = n
        self._available = available.tolist()
        self._resends = 0
        self.actions[:] = stay
        self.crashed[:] = 0

    def close(self) -> None:
        """Awaits nothing: later arrivals are ignored."""
        self._episode = self._step = -1
        self._missing = 0

    @property
    def complete(self) -> bool:
        """Every robot is decided."""
        return self._missing == 0 and self._episode >= 0

    @property
    def undecided(self) -> list[int]:
        """Robots (indexes) of which nothing has come yet."""
        return [] if self._missing == 0 else [i for i, d in enumerate(self._decided) if not d]

    def command(self, robot: int, episode: int, step: int, action: int, fault: int) -> bool:
        """A robot's command. Returns whether it counts: not if stale or a duplicate.

        Raises:
            ValueError: the action is not available to the robot.
        """
        if episode != self._episode or step != self._step:
            self.late[robot] += 1
            return False
        if self._decided[robot]:
            self.duplicates[robot] += 1
            return False
        allowed = self._available[robot]
        if not (0 <= action < len(allowed) and allowed[action]):
            raise ValueError(unavailable(self._robots[robot], action, allowed))
        self.actions[robot] = action
        if fault == _FAULT_NONE:
            self.health[robot] = Health.OK
        else:
            self.health[robot] = Health.FAULTED
            self.crashed[robot] = 1
        self._decided[robot] = True
        self._missing -= 1
        return True

    def mute(self, robot: int, episode: int, step: int) -> bool:
        """The notice that no command will come: the robot stays. Returns whether it counts."""
        if episode != self._episode or step != self._step or self._decided[robot]:
            return False
        self.health[robot] = Health.MUTED
        self.crashed[robot] = 1
        self._decided[robot] = True
        self._missing -= 1
        return True

    def resend(self, max_resends: int) -> list[int]:
        """Robots whose observation has to be sent again.

        Raises:
            TimeoutError: it was sent ``max_resends`` times again already; names the robots.
        """
        silent = self.undecided
        if not silent:
            return []
        if self._resends >= max_resends:
            names = ", ".join(self._robots[i] for i in silent)
            raise TimeoutError(
                f"no command for {names} in episode {self._episode}, step {self._step}, although "
                f"its observation was sent {max_resends + 1} times; no action is invented"
            )
        self._resends += 1
        return silent


def unavailable(robot: str, action: int, allowed: list[bool]) -> str:
    """The text of a refused command."""
    known = [i for i, ok in enumerate(allowed) if ok]
    return f"{robot} sent action {action}, which is not available; available: {known}"
