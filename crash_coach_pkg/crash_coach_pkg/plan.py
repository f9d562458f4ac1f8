"""The crash plan: who is faulted in an episode, when, for how long, and how."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from enum import IntEnum
from typing import Any, Protocol

NEXT_STEP = 0xFFFFFFFF
"""A start step that the gate resolves to the first step it has not relayed anything of."""


class TriggerKind(IntEnum):
    """What starts a fault at or after its start step; the values are Fault.trigger's on the wire.

    Every trigger but HAZARD fires once per episode.
    """

    STEP = 0  # the start step itself; no values
    HAZARD = 1  # (p,): at each step with probability p, and again after a recovery
    NEAR = 2  # (x_m, y_m, radius_m): the robot is within the radius of the point (map frame)
    RETURN_ABOVE = 3  # (x,): the episode's undiscounted return so far exceeds x


TRIGGER_VALUES = {
    TriggerKind.STEP: 0,
    TriggerKind.HAZARD: 1,
    TriggerKind.NEAR: 3,
    TriggerKind.RETURN_ABOVE: 1,
}


@dataclass(frozen=True)
class Trigger:
    """Raises ValueError for a number of values that does not fit the kind."""

    kind: TriggerKind = TriggerKind.STEP
    values: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        wanted = TRIGGER_VALUES[self.kind]
        if len(self.values) != wanted:
            raise ValueError(
                f"trigger {self.kind.name} has {len(self.values)} values, not {wanted}"
            )

    @property
    def needs_world(self) -> bool:
        """Whether it looks at positions or the return."""
        return self.kind in (TriggerKind.NEAR, TriggerKind.RETURN_ABOVE)


AT_START_STEP = Trigger()


@dataclass(frozen=True)
class Fault:
    robot: int  # index into the team
    mode: str  # a name that crash_coach_pkg.faults knows
    start_step: int = 0
    duration_steps: int = 0  # 0: until the episode ends
    parameters: tuple[tuple[str, float], ...] = ()  # of the mode; what is missing has its default
    trigger: Trigger = AT_START_STEP
    entry: int = 0  # which entry of a fault scenario it comes from


@dataclass(frozen=True)
class CrashPlan:
    """One episode's faults. ``seed`` keys everything random with (episode, step, robot).

    ``cap``: most robots that may be faulted together; triggers that would exceed it wait, also
    where they would leave no room for a fault with a start step of its own.
    """

    episode: int
    revision: int
    seed: int
    rate: float
    cap: int
    faults: tuple[Fault, ...] = ()

    def resolved(self, next_step: int) -> CrashPlan:
        """The same plan with every NEXT_STEP replaced."""
        return replace(
            self,
            faults=tuple(
                replace(f, start_step=next_step) if f.start_step == NEXT_STEP else f
                for f in self.faults
            ),
        )


def plan_to_json(plan: CrashPlan) -> dict[str, Any]:
    """What ``plan_from_json`` makes the same plan of."""
    return asdict(plan)


def plan_from_json(values: dict[str, Any]) -> CrashPlan:
    """Raises KeyError, TypeError or ValueError where it is no plan."""
    faults = tuple(_fault_from_json(fault) for fault in values["faults"])
    return CrashPlan(**{**values, "faults": faults})


def _fault_from_json(values: dict[str, Any]) -> Fault:
    parameters = tuple((name, value) for name, value in values["parameters"])
    kind, numbers = TriggerKind(values["trigger"]["kind"]), values["trigger"]["values"]
    trigger = Trigger(kind, tuple(numbers))
    return Fault(**{**values, "parameters": parameters, "trigger": trigger})


class Planner(Protocol):
    """What decides the faults of each episode: a Coach, or a fault scenario's planner."""

    def plan(self, episode: int) -> CrashPlan:
        """Of ``episode``: the same whenever, and in whatever order, it is asked for."""
        ...
