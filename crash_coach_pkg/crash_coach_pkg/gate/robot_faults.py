"""One robot's faults through an episode, whatever plans take over from each other in it.

The gate sees a robot's commands in order, but robots need not keep step with each other (nor the
observations with the commands): each stream follows the plan on its own, with the same result,
because everything in a plan is keyed by steps.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from crash_coach_common.contract import FloatArray
from crash_coach_pkg.faults import is_observation_mode
from crash_coach_pkg.faults.team_faults import Change, TeamFaults
from crash_coach_pkg.gate.plan_book import Event, EventKind, Term
from crash_coach_pkg.plan import Fault
from crash_coach_pkg.schedule import World

_KEPT = 1024  # worlds; a robot that is further behind sees no conditions


class RobotFaults:
    """Args: ``commands``: whether it follows the robot's commands; otherwise its observations."""

    def __init__(self, robot: int, n_robots: int, commands: bool) -> None:
        self.robot = robot
        self.running: list[Fault] = []
        """Faults of this stream that are in force."""
        self.passed: int | None = None
        """The command last passed on in this episode."""
        self.wanted: int | None = None
        """The command that the policy last wanted in this episode."""
        self.seen: FloatArray | None = None
        """What the policy last saw in this episode."""
        self._n = n_robots
        self._commands = commands
        self._term: Term | None = None
        self.team: TeamFaults[int] | None = None
        """Under the term that was followed last."""

    def begin(self) -> None:
        """A new episode."""
        self.running, self.passed, self.seen = [], None, None
        self.wanted = None
        self._term = self.team = None

    def expire(self) -> None:
        """The lease ran out: nothing is in force any more, as the team was told."""
        self.running = []
        self._term = self.team = None

    def follow(self, term: Term | None, step: int) -> list[Event]:
        """Goes over to ``term``; what ran under the one before ends, and is told where the new
        one has faults of its own (otherwise the whole team was told)."""
        if term is self._term:
            return []
        ended, self.running = self.running, []
        self._term = self.team = None
        if term is None:
            return []
        if self.robot in term.faulted:
            self._term = term
            passed: list[int | None] = [None] * self._n
            wanted: list[int | None] = [None] * self._n
            seen: list[FloatArray | None] = [None] * self._n
            passed[self.robot], seen[self.robot] = self.passed, self.seen
            wanted[self.robot] = self.wanted
            self.team = TeamFaults(term.plan, self._n, term.first_step, passed, seen, wanted)
        if not term.faulted:
            return []
        return [self._event(EventKind.CLEARED, step, fault, term) for fault in ended]

    def enter(self, step: int, world: World | None) -> list[Event]:
        """Goes on to ``step`` under the term; returns what begins and ends."""
        if self.team is None or self._term is None:
            return []
        term = self._term
        return [
            event
            for change in self.team.enter(step, world)
            for event in self._changed(change, term)
        ]

    def _changed(self, change: Change, term: Term) -> list[Event]:
        fault = change.fault
        if fault.robot != self.robot or is_observation_mode(fault.mode) == self._commands:
            return []
        if change.began:
            self.running.append(fault)
            return [self._event(EventKind.ACTIVE, change.step, fault, term)]
        self.running.remove(fault)
        return [self._event(EventKind.CLEARED, change.step, fault, term)]

    def _event(self, kind: EventKind, step: int, fault: Fault, term: Term) -> Event:
        return Event(
            kind, term.plan.episode, step, term.revision, fault.robot, fault.mode, fault.entry
        )


class Worlds:
    """The team's states that conditions look at, by (episode, step).

    Args: ``exact``: only the state of the very step will do (lock-step). Otherwise the newest one
    does, and whoever enters that step later gets the same.
    """

    def __init__(self, n_robots: int, exact: bool) -> None:
        self._n = n_robots
        self._exact = exact
        self._kept: dict[tuple[int, int], World] = {}

    def put(self, episode: int, step: int, world: World) -> None:
        """Keeps the state before ``step``, unless there is one already."""
        self._kept.setdefault((episode, step), world)
        if len(self._kept) > _KEPT:
            del self._kept[next(iter(self._kept))]

    def forget_before(self, episode: int) -> None:
        self._kept = {key: world for key, world in self._kept.items() if key[0] >= episode}

    def at(self, episode: int, step: int) -> World | None:
        """None: it has to come yet."""
        world = self._kept.get((episode, step))
        if world is None and not self._exact:
            world = self._newest(episode)
            self.put(episode, step, world)
        return world

    def between(self, episode: int, first: int, end: int) -> Iterator[tuple[int, World]]:
        """What is kept of steps ``first`` .. ``end`` - 1."""
        for step in range(first, end):
            if (world := self._kept.get((episode, step))) is not None:
                yield step, world

    def _newest(self, episode: int) -> World:
        steps = [step for of, step in self._kept if of == episode]
        if steps:
            return self._kept[episode, max(steps)]
        # Nothing is known: no condition holds.
        return World(np.full((self._n, 2), np.nan, dtype=np.float32), float("-inf"))
