"""The gate's decisions, without ROS: the single arbiter of every robot-step.

Every (episode, step, robot) is decided exactly once, by the plan that governs the step (PlanBook);
a duplicate gets the same decision again. Where observations are relayed too, the same holds for
each of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from crash_coach_common.contract import BoolArray
from crash_coach_pkg.effects import OBSERVED, WITHHELD
from crash_coach_pkg.faults import fault_mode, is_observation_mode
from crash_coach_pkg.faults.action_tools import ACTION_OFFERS, UNTOLD, ActionTools
from crash_coach_pkg.faults.base import Need
from crash_coach_pkg.faults.team_faults import TeamFaults
from crash_coach_pkg.gate.messages import Command, Decision, Outputs, Seen, Sight
from crash_coach_pkg.gate.plan_book import Event, EventKind, PlanBook, Term, why_not
from crash_coach_pkg.gate.robot_faults import RobotFaults, Worlds
from crash_coach_pkg.plan import CrashPlan
from crash_coach_pkg.schedule import World

_UNKNOWN = 2**32  # beyond every episode
_FROM_OBSERVATION: frozenset[Need] = frozenset(("availability", "sampler"))


class _Whole(NamedTuple):
    """A step of all robots that passed untouched, and that nobody has looked into yet."""

    key: tuple[int, int]
    revision: int
    commands: Callable[[], list[Command]]


class GateState:
    """Holds, resolves and applies crash plans for a team.

    Args:
        n_robots: size of the team.
        lockstep: hold commands (and observations) of an episode until its plan is there, and
            those that a fault or condition needs more for until that of the same step is there.
            Otherwise nothing is ever held: an episode without a plan has no faults, and the
            newest availability and state count; what needs them and has none is withheld.
        first_lease_s: how long the first commands are held for a coach that never spoke.
        relay_observations: whether policies see what this gate lets them; without, plans with
            observation faults are refused.
    """

    def __init__(
        self,
        n_robots: int,
        lockstep: bool,
        first_lease_s: float,
        relay_observations: bool = False,
    ) -> None:
        self._n = n_robots
        self._lockstep = lockstep
        self._relays = relay_observations
        self.book = PlanBook(lockstep, first_lease_s, self._why_not)
        self._begin_anew()
        self.late = [0] * n_robots
        """Commands dropped because a newer one of the same robot or a newer episode came first."""
        self.untold = [0] * n_robots
        """Robot-steps under a fault that needs the worst action, which the policy did not tell."""
        self.ahead = [0] * n_robots
        """Commands ignored because the sim can have asked nobody for them yet."""
        self._last_episode = _UNKNOWN  # that a command may be for
        self._begun = -1  # the sim's newest episode

    def _begin_anew(self) -> None:
        n_robots = self._n
        self._commands = [RobotFaults(robot, n_robots, True) for robot in range(n_robots)]
        self._sights = [RobotFaults(robot, n_robots, False) for robot in range(n_robots)]
        self._done: list[tuple[int, int]] = [(-1, -1)] * n_robots
        self._last: list[Decision | None] = [None] * n_robots
        self._held: list[Command | None] = [None] * n_robots
        self._seen: list[Seen | None] = [None] * n_robots
        self._held_sights: list[Sight | None] = [None] * n_robots
        self._masks: list[tuple[tuple[int, int], BoolArray] | None] = [None] * n_robots
        self._worlds = Worlds(n_robots, self._lockstep)
        self._whole: _Whole | None = None

    def last(self, robot: int) -> Decision | None:
        """The newest decision on ``robot``."""
        self._look_into()
        return self._last[robot]

    @property
    def watched_robots(self) -> frozenset[int]:
        """Robots whose observations a plan at hand needs."""
        return frozenset(
            fault.robot
            for plan in self.book.plans
            for fault in plan.faults
            if fault_mode(fault.mode).needs & _FROM_OBSERVATION
        )

    @property
    def needs_world(self) -> bool:
        """Whether a plan at hand needs ``world``."""
        return any(f.trigger.needs_world for plan in self.book.plans for f in plan.faults)

    def _why_not(self, plan: CrashPlan) -> str:
        return why_not(plan, ACTION_OFFERS, self._relays)

    # --- what comes in ----------------------------------------------------------------------

    def plan(self, plan: CrashPlan, lease_s: float, now_s: float) -> Outputs:
        """Takes a plan or its heartbeat (the same revision again)."""
        events = self.book.plan(plan, lease_s, now_s)
        return (*events, *self._release(now_s)) if events else ()

    def tick(self, now_s: float) -> Outputs:
        """Call often: ends the lease of a silent coach."""
        events = self.book.tick(now_s)
        if not events:
            return ()
        for stream in (*self._commands, *self._sights):
            stream.expire()
        return (*events, *self._release(now_s))

    def world(self, episode: int, step: int, world: World, now_s: float) -> Outputs:
        """Takes the team's state before ``step``, which conditions look at."""
        self._worlds.put(episode, step, world)
        return self._release(now_s)

    def boundary(self, episode: int, begins: bool) -> bool:
        """The sim has begun or ended ``episode``. Returns whether it was restarted (it begins
        each episode once, in ascending order): then all that was decided is forgotten.

        In real time no command is for an episode after the next: otherwise a single wrong number
        would make every later command late."""
        if not self._lockstep:  # there it is held for a plan that does not come
            self._last_episode = episode + 1
        if not begins:
            return False
        restarted, self._begun = episode <= self._begun, episode
        if restarted:
            self.book.begin_anew(episode)
            self._begin_anew()
        return restarted

    def whole_step(self, episode: int, step: int, commands: Callable[[], list[Command]]) -> bool:
        """Takes every robot's command of a step at once, where all of them pass untouched.

        Args:
            commands: makes them; called if and when they are looked at.

        Returns False, and has changed nothing, where they have to be taken one by one.
        """
        book, key = self.book, (episode, step)
        term = book.at(step)
        if episode != book.episode or (term is not None and term.faulted):
            return False
        if self._whole is None:
            if any(done >= key for done in self._done) or any(self._held):
                return False
            if any(stream.team is not None or stream.running for stream in self._commands):
                return False
        elif key <= self._whole.key:
            return False
        self._whole = _Whole(key, book.revision if term is None else term.revision, commands)
        book.next_step = max(book.next_step, step + 1)
        return True

    def _look_into(self) -> None:
        """Notes of each robot what was taken as a whole."""
        if self._whole is None:
            return
        whole, self._whole = self._whole, None
        for command in whole.commands():
            robot, action = command.robot, command.action
            self._done[robot] = whole.key
            self._last[robot] = Decision(command, "", 0, action, whole.revision)
            self._commands[robot].passed = self._commands[robot].wanted = action

    def command(self, command: Command, now_s: float) -> Outputs:
        """Decides a command, repeats the decision for a duplicate, holds or drops it."""
        self._look_into()
        if command.episode > self._last_episode:
            self.ahead[command.robot] += 1
            return ()
        key = (command.episode, command.step)
        done = self._done[command.robot]
        if key == done:
            last = self._last[command.robot]
            return () if last is None else (last._replace(repeated=True),)
        if key < done or command.episode < self.book.episode:
            self.late[command.robot] += 1
            return ()
        held = self._held[command.robot]
        if held is not None:
            if key == held.key:
                return ()
            self.late[command.robot] += 1
            if key < held.key:
                return ()
            self._held[command.robot] = None
        return self._decide(command, now_s)

    def observation(self, sight: Sight, now_s: float) -> Outputs:
        """Takes an observation: its availability, and all of it where observations are relayed."""
        self._look_into()
        robot = sight.robot
        self._masks[robot] = (sight.key, sight.available)
        outputs = self._see(sight, now_s) if self._relays else ()
        held = self._held[robot]
        if held is None:
            return outputs
        self._held[robot] = None
        return (*outputs, *self._decide(held, now_s))

    def _release(self, now_s: float) -> Outputs:
        outputs: list[Decision | Seen | Event] = []
        for robot in range(self._n):
            sight, self._held_sights[robot] = self._held_sights[robot], None
            if sight is not None:
                outputs.extend(self._see(sight, now_s))
            held, self._held[robot] = self._held[robot], None
            if held is not None:
                outputs.extend(self._decide(held, now_s))
        return tuple(outputs)

    def _enter(self, episode: int) -> bool:
        if not self.book.enter(episode):
            return False
        for stream in (*self._commands, *self._sights):
            stream.begin()
        self._worlds.forget_before(episode)
        return True

    # --- commands ---------------------------------------------------------------------------

    def _decide(self, command: Command, now_s: float) -> Outputs:
        """Decides or holds a command that is newer than everything decided for its robot."""
        robot, episode, step, action, _, _ = command
        book = self.book
        if episode != book.episode:
            if episode < book.episode:
                self.late[robot] += 1
                return ()
            if not self._enter(episode):
                book.wait(now_s)
                self._held[robot] = command
                return ()
        term = book.at(step)
        stream = self._commands[robot]
        events = stream.follow(term, step)
        if term is None or stream.team is None:
            stream.passed = stream.wanted = action
            revision = book.revision if term is None else term.revision
            decision = Decision(command, "", 0, action, revision)
        else:
            if not self._reach(stream, stream.team, (episode, step), events):
                self._held[robot] = command
                return tuple(events)
            faulted = self._fault(stream, stream.team, command, term)
            if faulted is None:
                self._held[robot] = command
                return tuple(events)
            decision = faulted
        self._done[robot] = (episode, step)
        self._last[robot] = decision
        if step >= book.next_step:
            book.next_step = step + 1
        return (*events, decision) if events else (decision,)

    def _fault(
        self, stream: RobotFaults, team: TeamFaults[int], command: Command, term: Term
    ) -> Decision | None:
        """The decision in the step entered; None: its availability is not there yet."""
        robot = command.robot
        needs, seen = team.needs(robot), self._masks[robot]
        if (
            self._lockstep
            and needs & _FROM_OBSERVATION
            and (seen is None or seen[0] != command.key)
        ):
            return None
        if "worst" in needs and command.worst == UNTOLD:
            self.untold[robot] += 1
        tools = ActionTools(None if seen is None else seen[1], command.worst)
        mode, entry, passed = team.command(robot, command.action, tools)
        stream.wanted = command.action
        if passed is not None:
            stream.passed = passed
        applied = WITHHELD if passed is None else passed
        of_sight = bool(mode) and is_observation_mode(mode)
        return Decision(command, mode, entry, applied, term.revision, observation=of_sight)

    # --- observations -----------------------------------------------------------------------

    def _see(self, sight: Sight, now_s: float) -> Outputs:
        robot, book = sight.robot, self.book
        last = self._seen[robot]
        if last is not None and sight.key <= last.sight.key:
            return (last,) if sight.key == last.sight.key else ()
        if sight.episode < book.episode:
            return ()
        if sight.episode > book.episode and not self._enter(sight.episode):
            book.wait(now_s)
            self._held_sights[robot] = sight
            return ()
        term = book.at(sight.step)
        stream = self._sights[robot]
        outputs: list[Event | Seen] = [*stream.follow(term, sight.step)]
        seen = sight.features
        if term is not None and stream.team is not None:
            begun: list[Event] = []
            reached = self._reach(stream, stream.team, sight.key, begun)
            outputs += begun
            if not reached:
                self._held_sights[robot] = sight
                return tuple(outputs)
            seen = stream.team.observation(robot, sight.features)
            mode = stream.team.observation_mode(robot)
            if mode:
                outputs.append(
                    self._effect(sight, mode, stream.team.observation_entry(robot), term)
                )
        stream.seen = seen
        made = Seen(sight, None if seen is sight.features else seen)
        self._seen[robot] = made
        if sight.step >= book.next_step:
            book.next_step = sight.step + 1
        return (*outputs, made)

    def _effect(self, sight: Sight, mode: str, entry: int, term: Term) -> Event:
        kind, revision = EventKind.EFFECT, term.revision
        return Event(kind, sight.episode, sight.step, revision, sight.robot, mode, entry, OBSERVED)

    def _reach(
        self, stream: RobotFaults, team: TeamFaults[int], key: tuple[int, int], events: list[Event]
    ) -> bool:
        """Enters the step, adding to ``events``; False: the world of that step is not there."""
        episode, step = key
        if not team.needs_world:
            events += stream.enter(step, None)
            return True
        world = self._worlds.at(episode, step)
        if world is None:
            return False
        # Steps that this stream skips but another one entered: both see the same conditions.
        for passed, before in self._worlds.between(episode, team.step + 1, step):
            events += stream.enter(passed, before)
        events += stream.enter(step, world)
        return True
