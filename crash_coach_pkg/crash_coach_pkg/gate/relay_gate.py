"""Faults on commands of any type, without ROS: the core of a gate for robots of your own.

Steps are those of a clock that is passed in, common to all robots, in one endless episode 0.
While no fault is in force every command passes at once and untouched. Under a fault a robot has
at most one command per step: the first one is decided as it comes, later ones of the same step
make way for each other, and the newest is decided as the next step begins.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from crash_coach_pkg.effects import RELAYED, WITHHELD
from crash_coach_pkg.faults import is_observation_mode
from crash_coach_pkg.faults.base import Need, Tools
from crash_coach_pkg.faults.team_faults import Change, Effect, TeamFaults
from crash_coach_pkg.gate.health import Decided
from crash_coach_pkg.gate.plan_book import Event, EventKind, PlanBook, Term, why_not
from crash_coach_pkg.plan import CrashPlan

EPISODE = 0


class Sent(NamedTuple):
    """A command to pass on."""

    robot: int
    data: bytes


Outputs = list[Sent | Event]


def refusal(plan: CrashPlan, offers: frozenset[Need] | None) -> str:
    """Why a relay whose commands offer no more than ``offers`` cannot carry out ``plan``; or ''.

    ``offers`` None: the type of the commands is not known yet.
    """
    if plan.episode != EPISODE:
        return (
            f"the plan is for episode {plan.episode}, but this gate knows no episodes: all is "
            f"episode {EPISODE} (start the coach with follow_sim:=false)"
        )
    if offers is None:
        unknown = (
            "the type of the commands is not known yet: nobody publishes any (command_type auto)"
        )
        return unknown if plan.faults else ""
    if reason := why_not(plan, offers, observations=True):
        return reason
    for fault in plan.faults:
        if is_observation_mode(fault.mode):
            return f"crash mode {fault.mode} changes observations; this gate relays only commands"
        if fault.trigger.needs_world:
            return (
                f"condition {fault.trigger.kind.name} looks at the sim's positions or return; "
                "this gate knows only commands"
            )
    return ""


class Relay:
    """Decides about a team's commands.

    Args:
        step_at: the step at a time; it never falls. Times are a steady clock's, in seconds, as
            those that leases are told by.

    Until ``know`` is called no plan with faults is accepted.
    """

    def __init__(self, n_robots: int, step_at: Callable[[float], int]) -> None:
        self._n = n_robots
        self._step_at = step_at
        self._offers: frozenset[Need] | None = None
        self._tools: Callable[[bytes], Tools[bytes]] | None = None
        self.book = PlanBook(False, 0.0, lambda plan: refusal(plan, self._offers))
        """The plans; read only."""
        self.book.enter(EPISODE)
        self._step = 0
        self._relayed_in = -1  # the newest step that a command was decided in
        self._last: list[bytes | None] = [None] * n_robots  # passed on
        self._wanted: list[bytes | None] = [None] * n_robots  # by the controller
        self._term: Term | None = None
        self._team: TeamFaults[bytes] | None = None  # None: the term has no faults
        self._running: list[Change] = []
        self._decided_in = [-1] * n_robots  # under a fault
        self._waiting: list[bytes | None] = [None] * n_robots  # for the next step

    def know(self, offers: frozenset[Need], tools: Callable[[bytes], Tools[bytes]]) -> None:
        """The type of the commands: what its tools can do, and the tools for the step in which
        that command is the newest."""
        self._offers, self._tools = offers, tools

    def decided(self) -> list[Decided]:
        """Of each robot, now."""
        team = self._team
        return [
            Decided("" if team is None else team.mode(robot), EPISODE, self._step)
            for robot in range(self._n)
        ]

    def command(self, robot: int, data: bytes, now_s: float) -> Outputs:
        """Takes a robot's command."""
        outputs = self._advance(now_s)
        self._relayed_in = self._step
        if self._team is None or not self._team.mode(robot):
            self._last[robot] = self._wanted[robot] = data
            outputs.append(Sent(robot, data))
        elif self._decided_in[robot] == self._step:
            self._waiting[robot] = data
        else:
            outputs += self._decide(self._team, robot, data)
        return outputs

    def plan(self, plan: CrashPlan, lease_s: float, now_s: float) -> Outputs:
        """Takes a plan or its heartbeat."""
        outputs = self._advance(now_s)
        self.book.next_step = self._step + (self._relayed_in == self._step)
        return [*outputs, *self.book.plan(plan, lease_s, now_s), *self._follow()]

    def tick(self, now_s: float) -> Outputs:
        """Call at least once in every step: ends leases and stretches, passes on what is due."""
        outputs = self._advance(now_s)
        self.book.next_step = self._step + (self._relayed_in == self._step)
        return [*outputs, *self.book.tick(now_s), *self._follow()]

    def _advance(self, now_s: float) -> Outputs:
        """Goes on to the step of ``now_s``."""
        step = self._step_at(now_s)
        if step <= self._step:
            return []
        outputs = self._idle()
        self._step = step
        return [*outputs, *self._follow()]

    def _idle(self) -> Outputs:
        """The end of a step: robots without a command in it."""
        outputs: Outputs = []
        if self._team is None:
            return outputs
        for robot in sorted(self._team.faulted):
            if self._decided_in[robot] != self._step:
                effect = self._team.idle(robot)
                if effect.passed is not None:
                    outputs += self._told(robot, effect)
        return outputs

    def _follow(self) -> Outputs:
        """Enters the step under the term that governs it."""
        outputs: Outputs = []
        term = self.book.at(self._step)
        if term is not self._term:
            # Where the new term has no faults at all, the whole team was told.
            if term is not None and term.faulted:
                outputs += [self._changed(EventKind.CLEARED, it, term) for it in self._running]
            self._term, self._team, self._running = term, None, []
            if term is not None:  # what came before will not be asked for again
                self.book.terms = self.book.terms[self.book.terms.index(term) :]
            if term is not None and term.faulted:
                last, wanted = self._last, self._wanted
                self._team = TeamFaults(term.plan, self._n, term.first_step, last, wanted=wanted)
                self._last, self._wanted = self._team.last, self._team.wanted
        if self._team is not None and term is not None:
            for change in self._team.enter(self._step):
                outputs.append(self._note(change, term))
        for robot, data in enumerate(self._waiting):
            if data is not None:
                outputs += self._take_up(robot, data)
        return outputs

    def _note(self, change: Change, term: Term) -> Event:
        if change.began:
            self._running.append(change)
            return self._changed(EventKind.ACTIVE, change, term)
        self._running = [it for it in self._running if it.fault is not change.fault]
        return self._changed(EventKind.CLEARED, change, term)

    def _take_up(self, robot: int, data: bytes) -> Outputs:
        """A command that waited for this step, or whose fault has ended."""
        if self._team is None or not self._team.mode(robot):
            self._waiting[robot] = None
            self._last[robot] = self._wanted[robot] = data
            return [Sent(robot, data)]
        if self._decided_in[robot] == self._step:
            return []
        self._waiting[robot] = None
        return self._decide(self._team, robot, data)

    def _decide(self, team: TeamFaults[bytes], robot: int, data: bytes) -> Outputs:
        assert self._tools is not None  # a plan with faults was accepted
        self._decided_in[robot] = self._step
        return self._told(robot, team.command(robot, data, self._tools(data)))

    def _told(self, robot: int, effect: Effect[bytes]) -> Outputs:
        """What goes out under a fault, and the event that says so."""
        sent = [] if effect.passed is None else [Sent(robot, effect.passed)]
        applied = WITHHELD if effect.passed is None else RELAYED
        revision = 0 if self._term is None else self._term.revision
        event = Event(
            EventKind.EFFECT,
            EPISODE,
            self._step,
            revision,
            robot,
            effect.mode,
            effect.entry,
            applied,
        )
        return [*sent, event]

    def _changed(self, kind: EventKind, change: Change, term: Term) -> Event:
        fault = change.fault
        return Event(
            kind, EPISODE, self._step, term.revision, fault.robot, change.mode, fault.entry
        )
