"""Real time without ROS: the newest command counts while it is young enough."""

from __future__ import annotations

import numpy as np

from crash_coach_common.contract import BoolArray, IntArray
from sim_pkg.lockstep import Health, unavailable

_NEVER_S = float("-inf")
_NO_STEP = -1


class NewestCommands:
    """Each robot's newest command and when it came. Times are a steady clock's, in seconds.

    Attributes:
        actions: (n,) int32, crashed: (n,) uint8, health: of each robot, after ``sample``.
        late: commands of each robot that answer an observation before the newest one.
        duplicates: commands of each robot for a step that it had answered before.
    """

    def __init__(self, robots: tuple[str, ...], cmd_timeout_s: float) -> None:
        n = len(robots)
        self._robots = robots
        self._timeout_s = cmd_timeout_s
        self._episode = -1
        self._step = 0
        self._answered = [_NO_STEP] * n
        self._action = [0] * n
        self._fault = [0] * n
        self._command_s = [_NEVER_S] * n
        self._mute_s = [_NEVER_S] * n
        self.actions: IntArray = np.zeros(n, dtype=np.int32)
        self.crashed = np.zeros(n, dtype=np.uint8)
        self.health = [Health.OK] * n
        self.late = [0] * n
        self.duplicates = [0] * n

    def open(self, episode: int) -> None:
        """A new episode: what was sent for the last one does not count in it."""
        n = len(self._robots)
        self._episode, self._step = episode, 0
        self._answered = [_NO_STEP] * n
        self._command_s = [_NEVER_S] * n
        self._mute_s = [_NEVER_S] * n

    def observed(self, step: int) -> None:
        """The observations of ``step`` go out: what answers an older one from now on is late."""
        self._step = step

    def command(
        self, robot: int, episode: int, step: int, action: int, fault: int, now_s: float
    ) -> None:
        """A command; one of another episode is ignored."""
        if episode != self._episode or step < self._step:
            self.late[robot] += 1
        elif step == self._answered[robot]:
            self.duplicates[robot] += 1
        if episode == self._episode:
            self._answered[robot] = step
            self._action[robot] = action
            self._fault[robot] = fault
            self._command_s[robot] = now_s

    def mute(self, robot: int, episode: int, now_s: float) -> None:
        """The gate withheld a command on purpose."""
        if episode == self._episode:
            self._mute_s[robot] = now_s

    def sample(self, stay: IntArray, available: BoolArray, now_s: float) -> list[str]:
        """Fills actions, crashed and health for the step that starts at ``now_s``.

        Args:
            stay: (n,) null action of each robot. available: (n, A).

        Returns:
            One line per command that was refused because it is not available.
        """
        refused = []
        self.actions[:] = stay
        self.crashed[:] = 0
        for robot, name in enumerate(self._robots):
            self.health[robot] = self._judge(robot, now_s)
            if self.health[robot] in (Health.OK, Health.FAULTED):
                allowed = available[robot].tolist()
                action = self._action[robot]
                if 0 <= action < len(allowed) and allowed[action]:
                    self.actions[robot] = action
                else:
                    refused.append(unavailable(name, action, allowed))
                    self.health[robot] = Health.LOST
            self.crashed[robot] = self.health[robot] in (Health.FAULTED, Health.MUTED)
        return refused

    def _judge(self, robot: int, now_s: float) -> Health:
        command_s, mute_s = self._command_s[robot], self._mute_s[robot]
        # The newer of the two says what the gate does to this robot now.
        if mute_s > command_s and now_s - mute_s < self._timeout_s:
            return Health.MUTED
        if now_s - command_s < self._timeout_s and command_s > mute_s:
            return Health.FAULTED if self._fault[robot] else Health.OK
        return Health.LOST
