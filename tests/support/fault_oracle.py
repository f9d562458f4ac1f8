"""What has to happen under a plan, worked out apart from the code under test and as plainly."""

from __future__ import annotations

import math

import numpy as np

from crash_coach_common.keyed_random import random_bits
from crash_coach_pkg.faults.batch_faults import random_available
from crash_coach_pkg.plan import NEXT_STEP, CrashPlan, Fault, TriggerKind
from crash_coach_pkg.schedule import World

WITHHELD = -1
OBSERVATION_MODES = ("blind", "stale", "noise")
HAZARD_STREAM = 1000


def world_of(episode: int, step: int, n_robots: int) -> World:
    """Robots on circles about the origin, and a return that grows."""
    angles = 0.7 * step + episode + np.arange(n_robots)
    positions_m = 3 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return World(positions_m.astype(np.float32), 0.5 * step)


class Oracle:
    """One plan that governs from ``first``, in a team of ``n`` that the cap does not limit."""

    def __init__(self, plan: CrashPlan, first: int, n: int) -> None:
        assert plan.cap >= n
        self.plan = plan
        self.first = first
        self._n = n

    def since(self, place: int, step: int) -> int | None:
        """First step of the stretch of fault ``place`` that is in force at ``step``."""
        fault = self.plan.faults[place]
        start = self.first if fault.start_step == NEXT_STEP else fault.start_step
        lasts = fault.duration_steps or 10**9
        if fault.trigger.kind == TriggerKind.STEP:
            return start if start <= step < start + lasts else None
        begun, t = None, max(self.first, start)
        while t <= step:
            if self._strikes(place, fault, t):
                begun = t
                if fault.trigger.kind != TriggerKind.HAZARD or t + lasts > step:
                    break
                t += lasts
            else:
                t += 1
        return begun if begun is not None and begun <= step < begun + lasts else None

    def _strikes(self, place: int, fault: Fault, step: int) -> bool:
        values, plan = fault.trigger.values, self.plan
        if fault.trigger.kind == TriggerKind.HAZARD:
            bits = random_bits(plan.seed, plan.episode, step, fault.robot, HAZARD_STREAM + place)
            return float(bits[0] >> np.uint64(11)) / 2**53 < values[0]
        world = world_of(plan.episode, step, self._n)
        if fault.trigger.kind == TriggerKind.RETURN_ABOVE:
            return world.episode_return > values[0]
        x_m, y_m = (float(v) for v in world.positions_m[fault.robot])
        return math.dist((x_m, y_m), values[:2]) <= values[2]

    def in_force(self, robot: int, step: int, observation: bool) -> tuple[Fault, int] | None:
        """The fault of the robot's commands (or observations) and where its stretch began."""
        found = None
        for place, fault in enumerate(self.plan.faults):
            if fault.robot == robot and (fault.mode in OBSERVATION_MODES) == observation:
                since = self.since(place, step)
                if since is not None:
                    found = fault, since
        return found


def random_action(seed: int, key: tuple[int, int, int], available: np.ndarray) -> int:
    return int(random_available(random_bits(seed, *key), available[None, :])[0])
