"""When each fault of a plan is in force: steps, durations, hazards and conditions."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

from crash_coach_common.contract import FloatArray
from crash_coach_common.keyed_random import bits_of_one
from crash_coach_pkg.plan import CrashPlan, Fault, TriggerKind

_HAZARD_STREAM = 1000  # + the fault's place in the plan
_NEVER = -1
# Most steps that are made up for where a command skips some; a step number may be anything up to
# 2^32, and a step of hazards takes 0.1 ms.
MOST_SKIPPED = 10_000


class World(NamedTuple):
    """What conditions look at, before the control step."""

    positions_m: FloatArray  # (n, 2), map frame
    episode_return: float  # undiscounted, so far


class Schedule:
    """Follows one episode under one plan; ``enter`` is called for steps in ascending order.

    A plan may start to govern in mid-episode: hazards are drawn from ``first_step`` on.
    """

    def __init__(self, plan: CrashPlan, first_step: int = 0) -> None:
        self._plan = plan
        self._next = first_step
        # Step at which the running stretch of each fault began.
        self._since = [_NEVER] * len(plan.faults)
        self._fired = [False] * len(plan.faults)
        self.needs_world = any(fault.trigger.needs_world for fault in plan.faults)
        self._hazards = any(fault.trigger.kind == TriggerKind.HAZARD for fault in plan.faults)
        self.in_force: dict[int, int] = {}
        """Of the faults in force at the step last entered: place in the plan -> first step.

        Ascending places. A fault whose time was over and that began again has another first step.
        """

    @property
    def step(self) -> int:
        """The step last entered; first_step - 1 before."""
        return self._next - 1

    def enter(self, step: int, world: World | None) -> None:
        """Goes on to ``step``; steps that were skipped count for hazards and durations (hazards:
        the last MOST_SKIPPED of them).

        Raises:
            ValueError: a step that was entered before, or conditions without a world.
        """
        if step < self._next:
            raise ValueError(f"step {step} comes after step {self._next - 1}")
        if self.needs_world and world is None:
            raise ValueError(f"step {step}: the plan has conditions, but there is no world")
        # Start steps and durations need nothing of the steps between.
        first = max(self._next, step - MOST_SKIPPED) if self._hazards else step
        for passed in range(first, step + 1):
            self._pass(passed, world if passed == step else None)
        self._next = step + 1
        self.in_force = {i: since for i, since in enumerate(self._since) if since != _NEVER}

    def _pass(self, step: int, world: World | None) -> None:
        faults = self._plan.faults
        for place, fault in enumerate(faults):
            since = self._since[place]
            if since != _NEVER and fault.duration_steps and step >= since + fault.duration_steps:
                self._since[place] = _NEVER
        for place, fault in enumerate(faults):
            if self._since[place] == _NEVER and self._starts(place, fault, step, world):
                self._fired[place] = True
                self._since[place] = (
                    fault.start_step if fault.trigger.kind == TriggerKind.STEP else step
                )

    def _starts(self, place: int, fault: Fault, step: int, world: World | None) -> bool:
        if step < fault.start_step:
            return False
        kind = fault.trigger.kind
        if kind == TriggerKind.STEP:
            end = fault.start_step + fault.duration_steps
            return not fault.duration_steps or step < end
        if kind != TriggerKind.HAZARD and self._fired[place]:
            return False
        return self._triggered(place, fault, step, world) and self._room_for(fault, step)

    def _triggered(self, place: int, fault: Fault, step: int, world: World | None) -> bool:
        values = fault.trigger.values
        if fault.trigger.kind == TriggerKind.HAZARD:
            plan = self._plan
            stream = _HAZARD_STREAM + place
            return _uniform(plan.seed, plan.episode, step, fault.robot, stream) < values[0]
        if world is None:  # a step that was skipped
            return False
        if fault.trigger.kind == TriggerKind.RETURN_ABOVE:
            return world.episode_return > values[0]
        x_m, y_m = (float(v) for v in world.positions_m[fault.robot])
        return (x_m - values[0]) ** 2 + (y_m - values[1]) ** 2 <= values[2] ** 2

    def _room_for(self, fault: Fault, step: int) -> bool:
        """Whether ``fault`` may begin: the cap holds in all of its time.

        Room is kept for robots that have a start step, so that these never wait.
        """
        others = {
            other.robot
            for place, other in enumerate(self._plan.faults)
            if other.robot != fault.robot
            and (self._since[place] != _NEVER or _overlaps(other, fault, step))
        }
        return len(others) < self._plan.cap


@lru_cache(maxsize=4096)
def _uniform(seed: int, episode: int, step: int, robot: int, stream: int) -> float:
    """In [0, 1). Kept, because a gate follows the schedule once for each robot of the team."""
    return (bits_of_one(seed, episode, step, robot, stream) >> 11) * 2.0**-53


def _overlaps(other: Fault, fault: Fault, step: int) -> bool:
    """Whether ``other`` is in force by its start step while ``fault``, begun at ``step``, lasts."""
    if other.trigger.kind != TriggerKind.STEP:
        return False
    if other.duration_steps and other.start_step + other.duration_steps <= step:
        return False
    return not fault.duration_steps or other.start_step < step + fault.duration_steps
