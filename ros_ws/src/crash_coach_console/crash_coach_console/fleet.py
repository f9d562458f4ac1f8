"""Robots that this project does not simulate: where their odometry says they are, as an arena."""

from __future__ import annotations

import math
from collections.abc import Sequence

from crash_coach_console.arena import Arena, State

RADIUS_M = 0.25
AROUND_M = 1.0
BLOCK_M = 5.0
"""The arena that is shown grows by this."""

Pose = tuple[float, float, float]


class Fleet:
    """``robots``: names, in order. One that has told no pose yet is not drawn."""

    def __init__(self, robots: Sequence[str]) -> None:
        self.robots = tuple(robots)
        self._poses: dict[str, Pose] = {}
        self._bounds_m = (0.0, 0.0, 0.0, 0.0)
        self._time_s = 0.0
        self.grown = True
        self.moved = False

    def told(self, robot: str, pose: Pose, time_s: float) -> None:
        """x, y in m and angle in rad of a robot; what is not finite is ignored."""
        if robot not in self.robots or not all(map(math.isfinite, pose)):
            return
        self.grown = self.grown or robot not in self._poses
        self._poses[robot] = pose
        self._time_s = max(self._time_s, time_s)
        self.moved = True
        x1, y1, x2, y2 = self._bounds_m
        x, y, _ = pose
        bounds = (
            min(x1, _below(x - AROUND_M)),
            min(y1, _below(y - AROUND_M)),
            max(x2, _above(x + AROUND_M)),
            max(y2, _above(y + AROUND_M)),
        )
        self.grown = self.grown or bounds != self._bounds_m
        self._bounds_m = bounds

    def _drawn(self) -> list[str]:
        return [name for name in self.robots if name in self._poses]

    def arena(self) -> Arena:
        """Around every place where a robot has been; ``grown`` is then false."""
        self.grown = False
        x1, y1, x2, y2 = self._bounds_m
        return Arena(
            scenario="",
            lockstep=False,
            dt_s=0.0,
            action_names=(),
            arena_m=(x2 - x1, y2 - y1),
            walled_m=self._bounds_m,
            cell_m=0.0,
            site_name="",
            site_radius_m=0.0,
            sites_m=(),
            rough_m=(),
            actors=tuple((n, "robot", "robots", RADIUS_M, (0.0, 0.0)) for n in self._drawn()),
        )

    def state(self, crashed: Sequence[str]) -> State:
        """Where everybody is, and who is ``crashed``; ``moved`` is then false."""
        self.moved = False
        drawn = self._drawn()
        return State(
            episode=0,
            step=0,
            time_s=self._time_s,
            episode_return=0.0,
            ended=False,
            success=False,
            poses=tuple(value for name in drawn for value in self._poses[name]),
            health=(1.0,) * len(drawn),
            shield=(0.0,) * len(drawn),
            sites_done=(),
            crashed=tuple(int(name in crashed) for name in drawn),
            hits=(),
        )


def _below(value: float) -> float:
    return BLOCK_M * math.floor(value / BLOCK_M)


def _above(value: float) -> float:
    return BLOCK_M * math.ceil(value / BLOCK_M)
