"""A team's faults under one plan: what happens to each robot's commands and observations.

The one path of every mode, for the gate (any order of robots) and for episodes played in one
process. Calls must come in ascending steps; per step and robot at most one command and at most
one observation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple

from crash_coach_common.contract import FloatArray
from crash_coach_pkg.faults import check_parameters, is_observation_mode, make_fault
from crash_coach_pkg.faults.base import C, CommandFault, Need, ObservationFault, Step, Tools
from crash_coach_pkg.plan import CrashPlan, Fault
from crash_coach_pkg.schedule import Schedule, World


class Effect(NamedTuple, Generic[C]):
    """What a robot gets. ``mode`` and ``entry``: of the fault in force; '' and 0 without one.

    ``passed``: the command; None: nothing is passed on.
    """

    mode: str
    entry: int
    passed: C | None


@dataclass(frozen=True, slots=True)
class Change:
    """A stretch that began (or ended) at ``step``."""

    began: bool
    step: int
    mode: str  # its name, where the plan has a synonym
    fault: Fault


@dataclass(slots=True)
class _Stretch:
    """A fault in force, and the object that carries it out."""

    fault: Fault
    since: int
    made: CommandFault[Any] | ObservationFault
    begun: bool = False  # whether a command fault has seen a command

    def change(self, began: bool, step: int) -> Change:
        return Change(began, step, self.made.name, self.fault)


class TeamFaults(Generic[C]):
    """Args: ``last``: what was last passed on to each robot in this episode, where a plan takes
    over from another in mid-episode; likewise ``last_seen`` of its observations, and ``wanted``:
    what its controller last wanted.

    Raises:
        UserError: an unknown mode, or parameters that it does not take.
    """

    def __init__(
        self,
        plan: CrashPlan,
        n_robots: int,
        first_step: int = 0,
        last: Sequence[C | None] | None = None,
        last_seen: Sequence[FloatArray | None] | None = None,
        wanted: Sequence[C | None] | None = None,
    ) -> None:
        self.plan = plan
        self.last: list[C | None] = [None] * n_robots if last is None else list(last)
        self.last_seen: list[FloatArray | None] = (
            [None] * n_robots if last_seen is None else list(last_seen)
        )
        self.wanted: list[C | None] = [None] * n_robots if wanted is None else list(wanted)
        for fault in plan.faults:
            check_parameters(fault.mode, dict(fault.parameters))
        # Whether what policies see must be kept: the arrays are the caller's buffers.
        self._watches = any(is_observation_mode(fault.mode) for fault in plan.faults)
        self._schedule = Schedule(plan, first_step)
        self._stretches: dict[int, _Stretch] = {}  # by place in the plan
        self._commands: dict[int, _Stretch] = {}  # by robot: the last one of the plan counts
        self._observations: dict[int, _Stretch] = {}

    @property
    def needs_world(self) -> bool:
        """Whether ``enter`` needs positions and return."""
        return self._schedule.needs_world

    @property
    def step(self) -> int:
        """The step last entered; first_step - 1 before."""
        return self._schedule.step

    def enter(self, step: int, world: World | None = None) -> list[Change]:
        """Goes on to ``step`` (again: nothing happens); returns stretches that begin or end.

        Raises:
            ValueError: an earlier step, or conditions without a world.
        """
        if step == self._schedule.step or not self.plan.faults:
            return []
        self._schedule.enter(step, world)
        in_force = self._schedule.in_force
        over = [p for p, s in self._stretches.items() if in_force.get(p) != s.since]
        changes = [self._stretches.pop(place).change(False, step) for place in over]
        for place, since in in_force.items():
            if place not in self._stretches:
                fault = self.plan.faults[place]
                made = make_fault(fault.mode, dict(fault.parameters))
                stretch = self._stretches[place] = _Stretch(fault, since, made)
                changes.append(stretch.change(True, step))
        if changes:
            self._sort_out()
        return changes

    def _sort_out(self) -> None:
        self._commands, self._observations = {}, {}
        for place in sorted(self._stretches):
            stretch = self._stretches[place]
            target = (
                self._commands if isinstance(stretch.made, CommandFault) else self._observations
            )
            target[stretch.fault.robot] = stretch

    def needs(self, robot: int) -> frozenset[Need]:
        """What the command fault in force on ``robot`` needs of the tools."""
        stretch = self._commands.get(robot)
        return stretch.made.needs if stretch is not None else frozenset()

    def mode(self, robot: int) -> str:
        """Of the fault in force: the command's, or else the observation's; '' without."""
        return self.command_mode(robot) or self.observation_mode(robot)

    def command_mode(self, robot: int) -> str:
        """Of the command fault in force on ``robot``; '' without."""
        return _mode(self._commands.get(robot))

    def observation_mode(self, robot: int) -> str:
        """Of the observation fault in force on ``robot``; '' without."""
        return _mode(self._observations.get(robot))

    def observation_entry(self, robot: int) -> int:
        """Of the observation fault in force on ``robot``; 0 without."""
        return _entry(self._observations.get(robot))

    @property
    def faulted(self) -> frozenset[int]:
        """Robots with any fault in force."""
        return frozenset((*self._commands, *self._observations))

    def command(self, robot: int, command: C, tools: Tools[C]) -> Effect[C]:
        """What ``robot`` gets in the step entered."""
        stretch = self._commands.get(robot)
        if stretch is None:
            self.last[robot] = self.wanted[robot] = command
            seen = self._observations.get(robot)
            return Effect(_mode(seen), _entry(seen), command)
        made = stretch.made
        assert isinstance(made, CommandFault)
        if not stretch.begun:
            stretch.begun = True
            made.begin(self.wanted[robot])
        self.wanted[robot] = command
        passed = made.apply(self._step(robot), command, self.last[robot], tools)
        if passed is not None and "availability" in made.needs and not tools.usable(passed):
            passed = None
        if passed is not None:
            self.last[robot] = passed
        return Effect(made.name, stretch.fault.entry, passed)

    def idle(self, robot: int) -> Effect[C]:
        """What ``robot`` gets in the step entered before any command came in it."""
        stretch = self._commands.get(robot)
        if stretch is None:
            return Effect("", 0, None)
        made = stretch.made
        assert isinstance(made, CommandFault)
        passed = made.idle(self._step(robot))
        if passed is not None:
            self.last[robot] = passed
        return Effect(made.name, stretch.fault.entry, passed)

    def observation(self, robot: int, features: FloatArray) -> FloatArray:
        """(O,) what ``robot``'s policy sees in the step entered; ``features`` itself, or new."""
        stretch = self._observations.get(robot)
        if stretch is None:
            self.last_seen[robot] = features.copy() if self._watches else features
            return features
        made = stretch.made
        assert isinstance(made, ObservationFault)
        seen = made.apply(self._step(robot), features, self.last_seen[robot])
        self.last_seen[robot] = seen
        return seen

    def _step(self, robot: int) -> Step:
        return Step(self.plan.seed, self.plan.episode, self._schedule.step, robot)


def _mode(stretch: _Stretch | None) -> str:
    return stretch.made.name if stretch is not None else ""


def _entry(stretch: _Stretch | None) -> int:
    return stretch.fault.entry if stretch is not None else 0
