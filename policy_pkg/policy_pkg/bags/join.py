"""Puts the messages of each episode together: by episode, step and robot, never by their order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from policy_pkg.bags.bag import Bag, Scan, bag_entries
from policy_pkg.bags.decode import Decoder, key_of
from policy_pkg.bags.problems import Problem, Report, Severity
from policy_pkg.bags.records import Channel, Entry, uncompressed
from policy_pkg.bags.topics import OF_ROBOT, Kind, kind_of

EFFECT = 1  # FaultEvent.EFFECT
OBSERVED = -2  # FaultEvent.OBSERVED
MEMORY_BYTES = 256 << 20
_OVERHEAD_BYTES = 200  # of a message in the dictionaries below, about
Key = tuple[int, int]  # (step, index of the robot)


@dataclass
class Pieces:
    """What has come of one episode so far. Duplicates are dropped, contradictions noted."""

    number: int
    raw: dict[Kind, dict[Key, tuple[Channel, bytes]]] = field(
        default_factory=lambda: {kind: {} for kind in OF_ROBOT}
    )
    states: dict[int, tuple[Any, bytes]] = field(default_factory=dict)  # by step
    end: Any = None  # EpisodeState with terminated or truncated
    effects: dict[Key, Any] = field(default_factory=dict)  # FaultEvents of commands
    observed: dict[Key, Any] = field(default_factory=dict)  # FaultEvents of observations
    plan: Any = None  # CrashPlan of the highest revision
    conflicts: dict[str, None] = field(default_factory=dict)
    nbytes: int = 0

    def conflict(self, text: str) -> None:
        self.conflicts.setdefault(text)

    def add_raw(self, kind: Kind, key: Key, robot: str, channel: Channel, data: bytes) -> bool:
        """Whether it is new."""
        known = self.raw[kind].setdefault(key, (channel, data))
        if known[1] is data:
            self.nbytes += len(data) + _OVERHEAD_BYTES
            return True
        if known[1] != data:
            self.conflict(
                f"/{robot}/{kind.value}, step {key[0]}, comes twice with different content: "
                "two sims, or a restarted one, in one bag"
            )
        return False

    def add_state(self, state: Any, data: bytes) -> None:
        self.nbytes += len(data) + _OVERHEAD_BYTES
        ended = bool(state.terminated or state.truncated)
        known, known_data = self.states.get(state.step, (state, data))
        if known_data != data and not _same_situation(known, state):
            self.conflict(
                f"two states of step {state.step}, seeds {known.seed} and {state.seed}: "
                "two sims, or a restarted one, in one bag"
            )
        if ended:
            if self.end is not None and self.end.step != state.step:
                self.conflict(f"it ends at step {self.end.step} and at step {state.step}")
            self.end = state
        if ended or state.step not in self.states:
            self.states[state.step] = (state, data)

    def add_event(self, event: Any, robot: int) -> None:
        self.nbytes += _OVERHEAD_BYTES
        events = self.observed if event.applied == OBSERVED else self.effects
        known = events.setdefault((event.step, robot), event)
        if (known.mode, known.intent, known.applied) != (event.mode, event.intent, event.applied):
            self.conflict(f"two different effects on {event.robot}, step {event.step}")

    def add_plan(self, plan: Any) -> None:
        if self.plan is None or plan.revision > self.plan.revision:
            self.plan = plan


def _same_situation(one: Any, other: Any) -> bool:
    """Whether they differ at most in how the episode ended: one of them may have been cut short."""
    return bool(
        one.seed == other.seed
        and one.reward == other.reward
        and one.state.tobytes() == other.state.tobytes()
        and one.actions.tobytes() == other.actions.tobytes()
        and one.crashed.tobytes() == other.crashed.tobytes()
    )


class Joiner:
    """Reads one bag; ``episodes`` yields each episode's pieces, once, when nothing more can come.

    That is when ``complete`` says so, at the end of the bag, or when more than ``memory_bytes``
    are held: then the one begun first has to go.
    """

    def __init__(
        self, bag: Bag, scan: Scan, report: Report, memory_bytes: int = MEMORY_BYTES
    ) -> None:
        self.bag, self.scan = bag, scan
        self.decoder = Decoder()
        self.messages = 0  # on topics that the reader needs
        self.repeated = 0  # of them, those that say nothing new of a robot-step
        self.disordered = 0  # of them, those received before the one before them in the file
        self._newest_ns = 0
        self.first_ns, self.last_ns = 0, 0
        self.about = scan.about
        self.met: set[Kind] = set()
        self._report = report
        self._robots = {name: index for index, name in enumerate(scan.robots)}
        self._channels: dict[Channel, tuple[Kind, str, int] | None] = {}
        self._open: dict[int, Pieces] = {}
        self._over: dict[int, tuple[int, str]] = {}  # (seed, trajectory hash) by episode
        self._repeated: set[int] = set()
        self._nbytes = 0
        self._memory_bytes = memory_bytes

    def pieces(self) -> Iterator[tuple[Pieces, bool]]:
        """(pieces, whether it is the last word): the caller closes what it is done with."""
        for item in bag_entries(self.bag, self._report):
            if not isinstance(item, Entry):
                self.about = item
                continue
            touched = self._add(item)
            if touched is not None and touched.end is not None:
                yield touched, False
            while self._nbytes > self._memory_bytes and self._open:
                yield next(iter(self._open.values())), True
        while self._open:
            yield next(iter(self._open.values())), True

    def close(self, pieces: Pieces) -> None:
        """Nothing more of this episode is wanted."""
        del self._open[pieces.number]
        self._nbytes -= pieces.nbytes
        end = pieces.end
        self._over[pieces.number] = (end.seed, end.trajectory_hash) if end is not None else (-1, "")

    def problem(self, text: str, severity: Severity = Severity.DAMAGED) -> None:
        self._report(Problem(self.bag.name, text, severity))

    def _add(self, entry: Entry) -> Pieces | None:
        """Files a message; returns the episode that it belongs to, if it is still open."""
        channel = entry.channel
        try:
            found = self._channels[channel]
        except KeyError:
            found = self._channels[channel] = self._learn(channel)
        if found is None:
            return None
        self._count(entry.log_time_ns)
        kind, name, robot = found
        self.met.add(kind)
        try:
            data = uncompressed(entry.data)
            if kind in OF_ROBOT:
                number, step = key_of(data)
                return self._add_raw(kind, number, (step, robot), name, channel, data)
            return self._add_other(kind, self.decoder.decode(channel, data), data)
        except ValueError as error:
            self.problem(f"topic {channel.topic}: {error}")
            return None

    def _add_raw(
        self, kind: Kind, number: int, key: Key, name: str, channel: Channel, data: bytes
    ) -> Pieces | None:
        pieces = self._pieces(number)
        if pieces is None:
            self.repeated += 1
            return None
        before = pieces.nbytes
        if not pieces.add_raw(kind, key, name, channel, data):
            self.repeated += 1
        self._nbytes += pieces.nbytes - before
        return pieces

    def _add_other(self, kind: Kind, message: Any, data: bytes) -> Pieces | None:
        if kind is Kind.EVENT and message.kind != EFFECT:
            return None
        pieces = self._pieces(message.episode)
        if pieces is None:
            if kind is Kind.STATE:
                self._check_repeated(message)
            return None
        before = pieces.nbytes
        if kind is Kind.STATE:
            pieces.add_state(message, data)
        elif kind is Kind.PLAN:
            pieces.add_plan(message)
        elif message.robot in self._robots:
            pieces.add_event(message, self._robots[message.robot])
        else:
            pieces.conflict(f"an effect on {message.robot!r}, who is not one of the team")
        self._nbytes += pieces.nbytes - before
        return pieces

    def _pieces(self, number: int) -> Pieces | None:
        """None for an episode that is over."""
        if number in self._over:
            return None
        return self._open.setdefault(number, Pieces(number))

    def _learn(self, channel: Channel) -> tuple[Kind, str, int] | None:
        match = kind_of(channel.topic)
        if match is None:
            return None
        kind, robot = match
        problem = self.decoder.learn(channel, kind)
        if problem is None and robot and robot not in self._robots:
            team = ", ".join(self._robots)
            problem = f"topic {channel.topic}: {robot} is not one of the team ({team})"
        if problem is not None:
            self.problem(problem)
            return None
        return kind, robot, self._robots.get(robot, -1)

    def _check_repeated(self, state: Any) -> None:
        """An episode that is over comes again: harmless only where it is the same one."""
        seed, digest = self._over[state.episode]
        ended = state.terminated or state.truncated
        same = seed == state.seed and (not ended or digest == state.trajectory_hash)
        if seed >= 0 and not same and state.episode not in self._repeated:
            self._repeated.add(state.episode)
            self.problem(
                f"episode {state.episode} comes twice, seeds {seed} and {state.seed}: two sims, "
                "or a restarted one, in one bag; the second is left out"
            )

    def _count(self, log_time_ns: int) -> None:
        self.first_ns = min(self.first_ns, log_time_ns) if self.messages else log_time_ns
        self.last_ns = max(self.last_ns, log_time_ns)
        self.messages += 1
        self.disordered += log_time_ns < self._newest_ns
        self._newest_ns = log_time_ns
