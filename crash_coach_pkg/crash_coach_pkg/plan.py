"""The crash plan: who is faulted in an episode, from when, for how long, and how."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
import numpy.typing as npt

NEXT_STEP = 0xFFFFFFFF
"""A start step that the gate resolves to the first step it has not relayed anything of."""


class Mode(IntEnum):
    """What happens to a robot's command; the values are Action.fault's on the wire."""

    NONE = 0
    MUTE = 1  # no command arrives, the robot stays
    RANDOM = 2  # a uniform available action instead


MODE_NAMES = {"mute": Mode.MUTE, "stay": Mode.MUTE, "random": Mode.RANDOM}
"""Accepted spellings; ``stay`` is the paper's word for ``mute``."""


def parse_mode(name: str) -> Mode:
    """Raises ValueError naming the accepted modes."""
    try:
        return MODE_NAMES[name]
    except KeyError:
        known = ", ".join(sorted(MODE_NAMES))
        raise ValueError(f"unknown crash mode {name!r}; one of: {known}") from None


@dataclass(frozen=True)
class Fault:
    robot: int  # index into the team
    mode: Mode
    start_step: int = 0
    duration_steps: int = 0  # 0: until the episode ends

    def covers(self, step: int) -> bool:
        if step < self.start_step:
            return False
        return self.duration_steps == 0 or step < self.start_step + self.duration_steps


@dataclass(frozen=True)
class CrashPlan:
    """One episode's faults. ``seed`` keys random actions with (episode, step, robot)."""

    episode: int
    revision: int
    seed: int
    rate: float
    cap: int
    faults: tuple[Fault, ...] = ()

    def modes_at(self, step: int, n_robots: int) -> npt.NDArray[np.uint8]:
        """(n,) Mode of each robot at ``step``; the last matching fault counts."""
        modes = np.zeros(n_robots, dtype=np.uint8)
        for fault in self.faults:
            if fault.covers(step):
                modes[fault.robot] = fault.mode
        return modes

    def mode_of(self, step: int, robot: int) -> Mode:
        """Mode of one robot at ``step``, as in modes_at."""
        for fault in reversed(self.faults):
            if fault.robot == robot and fault.covers(step):
                return fault.mode
        return Mode.NONE

    def resolved(self, next_step: int) -> CrashPlan:
        """The same plan with every NEXT_STEP replaced."""
        return replace(
            self,
            faults=tuple(
                replace(f, start_step=next_step) if f.start_step == NEXT_STEP else f
                for f in self.faults
            ),
        )
