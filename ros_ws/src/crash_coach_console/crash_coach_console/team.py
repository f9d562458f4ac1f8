"""A running team as pages show it: each robot's fault, health of its commands, last actions.

Told by a graph's topics in whatever order they come; without ROS.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from crash_coach_pkg.plan import NEXT_STEP

KEPT_STEPS = 32
OK, FAULTED, LOST = "ok", "faulted", "lost"


@dataclass(frozen=True)
class PlannedFault:
    """Of a plan: what is to strike ``robot``."""

    robot: str
    mode: str
    start_step: int
    duration_steps: int
    parameters: Mapping[str, float]
    trigger: str  # name of a TriggerKind


@dataclass(frozen=True)
class Plan:
    """An episode's faults as the coach published them, or as the gate carries them out."""

    episode: int
    revision: int
    rate: float
    faults: tuple[PlannedFault, ...]


@dataclass
class _Robot:
    mode: str = ""  # of the fault in force
    told: bool = False  # whether events have told of it: diagnostics lag behind them
    lost: dict[str, str] = field(default_factory=dict)  # who says so, and in which words
    note: str = ""
    taken: deque[list[Any]] = field(default_factory=lambda: deque(maxlen=KEPT_STEPS))
    effects: dict[tuple[int, int], tuple[str, int, int]] = field(default_factory=dict)


class LiveTeam:
    """``robots``: names, in order; more appear where a topic tells of them."""

    def __init__(self) -> None:
        self._robots: dict[str, _Robot] = {}
        self._episode = -1
        self._plan: Plan | None = None
        self._in_force: Plan | None = None
        self.changed = True

    @property
    def robots(self) -> tuple[str, ...]:
        return tuple(self._robots)

    @property
    def crashed(self) -> tuple[str, ...]:
        """Robots that a fault is in force on."""
        return tuple(name for name, robot in self._robots.items() if robot.mode)

    def name(self, robots: Sequence[str]) -> None:
        """Who is in the team, in order."""
        if tuple(robots) != self.robots:
            self._robots = {name: self._robots.get(name, _Robot()) for name in robots}
            self.changed = True

    def episode(self, number: int) -> None:
        """An episode begins: faults of the last one are over."""
        if number != self._episode:
            self._episode = number
            for robot in self._robots.values():
                robot.mode, robot.told = "", True
                robot.effects.clear()
            self.changed = True

    def plan(self, plan: Plan) -> None:
        """Of the coach."""
        self.changed = self.changed or plan != self._plan
        self._plan = plan

    def in_force(self, plan: Plan) -> None:
        """Of the gate; without faults after a lease ran out."""
        self.changed = self.changed or plan != self._in_force
        self._in_force = plan
        if not plan.faults:
            self.cleared("")

    def active(self, robot: str, mode: str, episode: int) -> None:
        """A fault is in force on ``robot`` from now on."""
        if robot in self._robots and episode >= self._episode:
            self._robots[robot].mode = mode
            self._robots[robot].told = True
            self.changed = True

    def cleared(self, robot: str) -> None:
        """The fault of ``robot`` is over; '': of everybody."""
        for name, state in self._robots.items():
            if robot in ("", name):
                state.told = True
                self.changed = self.changed or bool(state.mode)
                state.mode = ""

    def effect(
        self, robot: str, mode: str, key: tuple[int, int], intent: int, applied: int
    ) -> None:
        """What a fault did in the robot-step ``key`` (episode, step)."""
        state = self._robots.get(robot)
        if state is None:
            return
        state.effects[key] = (mode, intent, applied)
        while len(state.effects) > KEPT_STEPS:
            del state.effects[next(iter(state.effects))]
        if key[0] >= self._episode and state.mode != mode:
            state.mode = mode
        state.told = True
        self.changed = True

    def executed(self, episode: int, step: int, actions: Sequence[int]) -> None:
        """Actions, in robot order, of the step before ``step``."""
        if step == 0:
            return
        for name, action in zip(self._robots, actions, strict=False):
            state = self._robots[name]
            key = (episode, step - 1)
            if not state.taken or tuple(state.taken[-1][:2]) != key:
                state.taken.append([*key, action])
        self.changed = True

    def diagnosed(self, who: str, robot: str, state: str, words: str, mode: str | None) -> None:
        """A line of /diagnostics. who: sim or gate; mode: in force, as the gate has it: it counts
        until an event tells of the robot."""
        known = self._robots.get(robot)
        if known is None:
            return
        before = (dict(known.lost), known.note, known.mode)
        if state == LOST:
            known.lost[who] = words
        else:
            known.lost.pop(who, None)
        if who == "gate":
            known.note = words if state == OK and words != OK else ""
        if mode is not None and state != LOST and not known.told:
            known.mode = mode
        self.changed = self.changed or before != (known.lost, known.note, known.mode)

    def value(self) -> dict[str, Any]:
        """JSON values for the page; ``changed`` is then false.

        Per robot: ``state``: ok, faulted or lost; ``mode``: of the fault in force; ``planned``:
        what the coach's plan has for it; ``steps``: [episode, step, intent, applied, mode] of the
        last ones, intent -1 where it is not known, applied as FaultEvent has it.
        """
        self.changed = False
        plan = self._plan
        return {
            "rate": None if plan is None else plan.rate,
            "revision": None if plan is None else plan.revision,
            "robots": [self._told(name, state) for name, state in self._robots.items()],
        }

    def _told(self, name: str, robot: _Robot) -> dict[str, Any]:
        state = LOST if robot.lost else FAULTED if robot.mode else OK
        words = "; ".join(f"{who}: {text}" for who, text in robot.lost.items()) or robot.note
        return {
            "name": name,
            "state": state,
            "mode": robot.mode,
            "words": words,
            "planned": self._planned(name),
            "steps": self._steps(robot),
        }

    def _planned(self, name: str) -> list[dict[str, Any]]:
        plan = self._plan
        if plan is None:
            return []
        return [
            {
                "mode": fault.mode,
                "start": None if fault.start_step == NEXT_STEP else fault.start_step,
                "duration": fault.duration_steps,
                "parameters": dict(fault.parameters),
                "trigger": fault.trigger,
            }
            for fault in plan.faults
            if fault.robot == name
        ]

    def _steps(self, robot: _Robot) -> list[list[Any]]:
        rows = {}
        for episode, step, action in robot.taken:
            mode, intent, applied = robot.effects.get((episode, step), ("", action, action))
            rows[episode, step] = [episode, step, intent, applied, mode]
        for (episode, step), (mode, intent, applied) in robot.effects.items():
            rows[episode, step] = [episode, step, intent, applied, mode]
        return [rows[key] for key in sorted(rows)][-KEPT_STEPS:]
