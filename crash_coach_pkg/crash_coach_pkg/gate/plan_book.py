"""Which plan governs which step: revisions, arming, clearing and leases, without ROS.

A plan governs from the first step of its episode that nothing was relayed of when it came. When
the coach is silent for longer than its lease, no plan governs until one comes again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import NamedTuple

from crash_coach_common.contract import UserError
from crash_coach_pkg.effects import NO_ACTION
from crash_coach_pkg.faults import check_parameters, is_observation_mode, unmet_needs
from crash_coach_pkg.faults.base import Need
from crash_coach_pkg.plan import CrashPlan

TEAM = -1
"""``Event.robot`` where an event concerns the whole team."""


class EventKind(IntEnum):
    """The values are FaultEvent's on the wire."""

    ARMED = 0
    EFFECT = 1
    CLEARED = 2
    EXPIRED = 3
    ACTIVE = 4
    REFUSED = 5
    INTRUDER = 6


class Event(NamedTuple):
    """``step``: the first that the change governs. The fields are FaultEvent's on the wire.

    Every ACTIVE of a robot is ended by a CLEARED of the robot or of the team, by EXPIRED, or by
    the end of its episode.
    """

    kind: EventKind
    episode: int
    step: int
    revision: int
    robot: int = TEAM
    mode: str = ""
    entry: int = 0
    applied: int = NO_ACTION
    detail: str = ""


def why_not(plan: CrashPlan, offered: frozenset[Need], observations: bool) -> str:
    """Why a gate cannot carry out ``plan``; empty where it can.

    Args:
        offered: what its commands' type offers to faults.
        observations: whether it relays observations.
    """
    for fault in plan.faults:
        try:
            check_parameters(fault.mode, dict(fault.parameters))
        except UserError as error:
            return str(error)
        if unmet := unmet_needs(fault.mode, offered):
            return unmet
        if is_observation_mode(fault.mode) and not observations:
            return not_relayed(fault.mode)
    return ""


def not_relayed(mode: str) -> str:
    """What is said of a fault of observations to a gate that does not relay them."""
    return (
        f"fault {mode} changes observations, which this gate does not relay: start it with "
        "relay_observations:=true, and the policies with observation_topic:=observation_seen"
    )


@dataclass(eq=False, slots=True)
class Term:
    """A plan and the first step that it governs. ``revision``: the newest with these faults."""

    first_step: int
    plan: CrashPlan
    revision: int
    faulted: frozenset[int]  # robots with a fault in the plan

    @classmethod
    def of(cls, first_step: int, plan: CrashPlan) -> Term:
        """The plan from ``first_step`` on, with every NEXT_STEP replaced by it."""
        plan = plan.resolved(first_step)
        return cls(first_step, plan, plan.revision, frozenset(f.robot for f in plan.faults))

    def same_faults(self, plan: CrashPlan) -> bool:
        """Whether ``plan`` says the same: then it takes over without a jump."""
        mine = self.plan
        return (mine.episode, mine.seed, mine.cap, mine.faults) == (
            plan.episode, plan.seed, plan.cap, plan.faults
        )  # fmt: skip


class PlanBook:
    """Follows the coach's plans for one stream of steps.

    Its owner calls ``enter`` for each new episode and keeps ``next_step`` up to date.

    Args:
        hold: an episode may only be entered once its plan is there, or the lease ran out.
        first_lease_s: how long is waited for a coach that never spoke.
        refuse: why a plan cannot be carried out; empty where it can.
    """

    def __init__(
        self, hold: bool, first_lease_s: float, refuse: Callable[[CrashPlan], str]
    ) -> None:
        self._hold = hold
        self._first_lease_s = first_lease_s
        self._refuse = refuse
        self.episode = -1
        """The newest that was entered."""
        self.next_step = 0
        """First step of the episode that nothing was relayed of."""
        self.terms: list[Term] = []
        """Of the episode, in ascending first_step."""
        self.pending: Term | None = None
        """For a later episode."""
        self.revision = 0
        self.lease_s = first_lease_s
        self.ignored = 0
        """Plans with an older revision or for an older episode."""
        self._known = False  # a plan was accepted, and its lease has not run out
        self._expired = False
        self._deadline_s: float | None = None
        self._accepted: CrashPlan | None = None  # the newest
        self._refused: int | None = None
        self.refusal = ""
        """Why the newest plan is not carried out; empty where it is."""

    def plan(self, plan: CrashPlan, lease_s: float, now_s: float) -> tuple[Event, ...]:
        """Takes a plan or its heartbeat (the same revision again).

        A refused plan counts as silence: it neither governs nor renews the lease.
        """
        if self._known and plan.revision == self.revision:
            self._deadline_s = now_s + lease_s
            return ()
        # After a lease ran out any revision is welcome: the coach may be a new one.
        if self._known and plan.revision < self.revision:
            self.ignored += 1
            return ()
        if plan.episode < self.episode:
            self.ignored += 1
            if self._known:
                self._deadline_s = now_s + lease_s
            return ()
        reason = self._refuse(plan)
        if reason:
            return self.refused(plan.episode, plan.revision, reason)
        self._known, self._expired = True, False
        self._accepted, self._refused, self.refusal = plan, None, ""
        self.revision, self.lease_s = plan.revision, lease_s
        self._deadline_s = now_s + lease_s
        return self._arm(plan)

    def refused(self, episode: int, revision: int, reason: str) -> tuple[Event, ...]:
        """Notes a revision that cannot be carried out; the event comes once."""
        if revision == self._refused:
            return ()
        self._refused, self.refusal = revision, reason
        return (Event(EventKind.REFUSED, episode, self.next_step, revision, detail=reason),)

    def _arm(self, plan: CrashPlan) -> tuple[Event, ...]:
        running = plan.episode == self.episode
        first = self.next_step if running else 0
        armed = Event(EventKind.ARMED, plan.episode, first, plan.revision)
        before = self.pending
        if running:
            before = self.terms[-1] if self.terms else None
        if before is not None and before.same_faults(plan):
            before.revision = plan.revision
            return (armed,)
        term = Term.of(first, plan)
        if running:
            self.terms = [term_ for term_ in self.terms if term_.first_step < first] + [term]
        else:
            self.pending = term
        replaced = before is not None and before.plan.episode == plan.episode
        if plan.faults or not replaced or before is None or not before.faulted:
            return (armed,)
        return (armed, armed._replace(kind=EventKind.CLEARED))

    def wait(self, now_s: float) -> None:
        """Somebody waits for a plan: from the first time on, a coach that never spoke is due."""
        if self._deadline_s is None:
            self._deadline_s = now_s + self._first_lease_s

    def tick(self, now_s: float) -> tuple[Event, ...]:
        """Call often: ends the lease of a silent coach."""
        if self._expired or self._deadline_s is None or now_s < self._deadline_s:
            return ()
        self._expired, self._known = True, False
        self.terms, self.pending = [], None
        return (Event(EventKind.EXPIRED, max(self.episode, 0), self.next_step, self.revision),)

    def enter(self, episode: int) -> bool:
        """Makes ``episode`` the current one where its plan is there or need not be."""
        pending = self.pending
        if pending is not None and pending.plan.episode == episode:
            self.terms = [pending]
        elif self._expired or not self._hold:
            self.terms = []
        else:
            return False
        self.episode, self.next_step = episode, 0
        if pending is not None and pending.plan.episode <= episode:
            self.pending = None
        return True

    def begin_anew(self, episode: int) -> None:
        """The sim was restarted with ``episode``. The revision and the lease go on: it is the
        same coach, whose plan counts again where it is for that episode."""
        self.episode, self.next_step = -1, 0
        self.terms, self.pending = [], None
        if self._known and self._accepted is not None and self._accepted.episode == episode:
            self.pending = Term.of(0, self._accepted)

    def at(self, step: int) -> Term | None:
        """What governs ``step`` of the current episode."""
        for term in reversed(self.terms):
            if term.first_step <= step:
                return term
        return None

    @property
    def plans(self) -> tuple[CrashPlan, ...]:
        """Every plan that may still govern a step."""
        terms = self.terms if self.pending is None else [*self.terms, self.pending]
        return tuple(term.plan for term in terms)

    @property
    def in_force(self) -> CrashPlan:
        """The newest plan that was accepted, start steps resolved; without faults after a lease
        ran out (a coach that starts then goes on from its rate), or where there was none yet."""
        newest = self.pending or (self.terms[-1] if self.terms else None)
        if newest is not None:
            return replace(newest.plan, revision=newest.revision)
        episode = max(self.episode, 0)
        if self._accepted is None:
            return CrashPlan(episode, self.revision, seed=0, rate=0.0, cap=0)
        return replace(self._accepted, episode=episode, cap=0, faults=())
