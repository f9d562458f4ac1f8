"""The gate's decisions, without ROS: the single arbiter of every robot-step.

Every (episode, step, robot) is decided exactly once, by the plan that governs the step; a
duplicate gets the same decision again. A plan governs from the first step of its episode that
nothing was relayed of when it came. When the coach is silent for longer than its lease, every
fault is cleared at once and commands pass untouched until a plan comes again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, NamedTuple

from crash_coach_pkg.gate import random_available, random_bits
from crash_coach_pkg.plan import CrashPlan, Mode
from sim_pkg.contract import BoolArray

NOTHING_APPLIED = -1


class EventKind(IntEnum):
    """The values are FaultEvent's on the wire; EFFECT is a Decision whose mode is not NONE."""

    ARMED = 0
    CLEARED = 2
    EXPIRED = 3


class Command(NamedTuple):
    """What a policy wants. ``token`` is the caller's own (its message) and is handed back.

    A tuple, as Decision is: a frozen dataclass takes five times as long to make, and the gate
    makes both for every robot-step.
    """

    robot: int
    episode: int
    step: int
    action: int
    token: Any = None

    @property
    def key(self) -> tuple[int, int]:
        return (self.episode, self.step)


class Decision(NamedTuple):
    """What the robot gets: ``applied``, or no command where that is NOTHING_APPLIED."""

    command: Command
    mode: Mode
    applied: int
    revision: int
    repeated: bool = False


@dataclass(frozen=True, slots=True)
class Event:
    """``step``: the first that the change governs."""

    kind: EventKind
    episode: int
    step: int
    revision: int


Outputs = tuple[Decision | Event, ...]


class GateState:
    """Holds, resolves and applies crash plans for a team.

    Args:
        n_robots: size of the team.
        lockstep: hold commands of an episode until its plan is there, and commands under a
            random fault until the observation of the same step is there. Otherwise nothing is
            ever held: an episode without a plan has no faults, a random action is drawn from the
            newest availability, and withheld where none was ever seen.
        first_lease_s: how long the first commands are held for a coach that never spoke.
    """

    def __init__(self, n_robots: int, lockstep: bool, first_lease_s: float) -> None:
        self._n = n_robots
        self._lockstep = lockstep
        self._first_lease_s = first_lease_s
        self._episode = -1  # of the schedule: the newest that anything was decided of
        self._schedule: list[tuple[int, CrashPlan]] = []  # (first step governed, plan), ascending
        self._pending: CrashPlan | None = None  # for a later episode
        self._revision = 0
        self._known = False  # a plan was accepted, and its lease has not run out
        self._expired = False
        self._deadline_s: float | None = None
        self._done: list[tuple[int, int]] = [(-1, -1)] * n_robots
        self._last: list[Decision | None] = [None] * n_robots
        self._held: list[Command | None] = [None] * n_robots
        self._masks: list[tuple[tuple[int, int], BoolArray] | None] = [None] * n_robots
        self.late = 0
        """Commands dropped because a newer one of the same robot or a newer episode came first."""
        self.ignored_plans = 0
        """Plans with an older revision or for an older episode."""

    @property
    def randomised_robots(self) -> frozenset[int]:
        """Robots whose observations (availability) a plan at hand needs."""
        plans = [plan for _, plan in self._schedule]
        if self._pending is not None:
            plans.append(self._pending)
        return frozenset(
            fault.robot for plan in plans for fault in plan.faults if fault.mode == Mode.RANDOM
        )

    def plan(self, plan: CrashPlan, lease_s: float, now_s: float) -> Outputs:
        """Takes a plan or its heartbeat (the same revision again)."""
        if self._known and plan.revision == self._revision:
            self._deadline_s = now_s + lease_s
            return ()
        # After a lease ran out any revision is welcome: the coach may be a new one.
        if self._known and plan.revision < self._revision:
            self.ignored_plans += 1
            return ()
        if plan.episode < self._episode:
            self.ignored_plans += 1
            self._extend(now_s + lease_s)
            return ()
        self._known, self._expired, self._revision = True, False, plan.revision
        self._deadline_s = now_s + lease_s
        return (*self._arm(plan), *self._release(now_s))

    def _extend(self, deadline_s: float) -> None:
        if self._known:
            self._deadline_s = deadline_s

    def _arm(self, plan: CrashPlan) -> Outputs:
        first, replaced = 0, self._pending
        if plan.episode == self._episode:
            first = self._next_step()
            replaced = self._schedule[-1][1] if self._schedule else None
            self._schedule = [entry for entry in self._schedule if entry[0] < first]
            self._schedule.append((first, plan.resolved(first)))
        else:
            self._pending = plan.resolved(0)
        armed = Event(EventKind.ARMED, plan.episode, first, plan.revision)
        had_faults = replaced is not None and replaced.episode == plan.episode and replaced.faults
        if plan.faults or not had_faults:
            return (armed,)
        return (armed, replace(armed, kind=EventKind.CLEARED))

    def _next_step(self) -> int:
        """First step of the current episode that nothing was relayed of."""
        return 1 + max(
            (step for episode, step in self._done if episode == self._episode), default=-1
        )

    def tick(self, now_s: float) -> Outputs:
        """Call often: ends the lease of a silent coach."""
        if self._expired or self._deadline_s is None or now_s < self._deadline_s:
            return ()
        self._expired, self._known = True, False
        self._schedule, self._pending = [], None
        event = Event(EventKind.EXPIRED, max(self._episode, 0), self._next_step(), self._revision)
        return (event, *self._release(now_s))

    def command(self, command: Command, now_s: float) -> Outputs:
        """Decides a command, repeats the decision for a duplicate, holds or drops it."""
        key = (command.episode, command.step)
        done = self._done[command.robot]
        if key == done:
            last = self._last[command.robot]
            return () if last is None else (last._replace(repeated=True),)
        if key < done or command.episode < self._episode:
            self.late += 1
            return ()
        held = self._held[command.robot]
        if held is not None:
            if key == held.key:
                return ()
            self.late += 1
            if key < held.key:
                return ()
            self._held[command.robot] = None
        return self._try(command, now_s)

    def observation(
        self, robot: int, episode: int, step: int, available: BoolArray, now_s: float
    ) -> Outputs:
        """Takes a robot's (A,) availability, which random faults draw from."""
        self._masks[robot] = ((episode, step), available)
        held = self._held[robot]
        if held is None:
            return ()
        self._held[robot] = None
        return self._try(held, now_s)

    def _release(self, now_s: float) -> Outputs:
        outputs: list[Decision | Event] = []
        for robot, held in enumerate(self._held):
            if held is not None:
                self._held[robot] = None
                outputs.extend(self._try(held, now_s))
        return tuple(outputs)

    def _try(self, command: Command, now_s: float) -> Outputs:
        """Decides or holds a command that is newer than everything decided for its robot."""
        if command.episode < self._episode:
            self.late += 1
            return ()
        if command.episode > self._episode and not self._enter(command.episode):
            return self._hold(command, now_s)
        plan = self._plan_at(command.step)
        mode = Mode.NONE if plan is None else plan.mode_of(command.step, command.robot)
        applied = command.action
        if plan is not None and mode == Mode.MUTE:
            applied = NOTHING_APPLIED
        elif plan is not None and mode == Mode.RANDOM:
            drawn = self._draw(plan, command)
            if drawn is None:
                return self._hold(command, now_s)
            applied = drawn
        decision = Decision(
            command, mode, applied, self._revision if plan is None else plan.revision
        )
        self._done[command.robot] = command.key
        self._last[command.robot] = decision
        return (decision,)

    def _enter(self, episode: int) -> bool:
        """Makes ``episode`` the current one where its plan is there or need not be."""
        pending = self._pending
        if pending is not None and pending.episode == episode:
            self._schedule = [(0, pending)]
        elif self._expired or not self._lockstep:
            self._schedule = []
        else:
            return False
        self._episode = episode
        if pending is not None and pending.episode <= episode:
            self._pending = None
        return True

    def _hold(self, command: Command, now_s: float) -> Outputs:
        self._held[command.robot] = command
        if self._deadline_s is None:
            self._deadline_s = now_s + self._first_lease_s
        return ()

    def _plan_at(self, step: int) -> CrashPlan | None:
        for first, plan in reversed(self._schedule):
            if first <= step:
                return plan
        return None

    def _draw(self, plan: CrashPlan, command: Command) -> int | None:
        """The random action; None: its availability is not there yet."""
        seen = self._masks[command.robot]
        if self._lockstep and (seen is None or seen[0] != command.key):
            return None
        if seen is None:
            return NOTHING_APPLIED
        bits = random_bits(plan.seed, command.episode, command.step, command.robot)
        return int(random_available(bits, seen[1][None, :])[0])
