"""One running graph's messages to episodes, as they come; see bags.join for the same from files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from crash_coach_common.contract import UserError
from policy_pkg.bags.assemble import (
    ContradictionError,
    IncompleteError,
    Wanted,
    assemble,
    counts_suffice,
)
from policy_pkg.bags.dataset import RecordedEpisode, recorded_episode
from policy_pkg.bags.decode import Decodes
from policy_pkg.bags.join import EFFECT, Pieces
from policy_pkg.bags.records import Channel
from policy_pkg.bags.topics import TYPES, Kind

OPEN_EPISODES = 4  # more begun ones than that: the oldest has to go


@dataclass(frozen=True)
class Lost:
    """An episode that cannot be used."""

    number: int
    reason: str


class Inbox:
    """Holds the pieces of the newest few episodes.

    Args:
        name: of the graph, for messages.
        robots: of the team, in order.
        lockstep: how the sim runs.
        seen: what the policies see comes on a topic of its own.
        decoder: of the robots' messages; ``Channel.msgtype`` is all that it may look at.
    """

    def __init__(
        self, name: str, robots: tuple[str, ...], lockstep: bool, seen: bool, decoder: Decodes
    ) -> None:
        self._name, self._robots, self._lockstep = name, robots, lockstep
        self._decoder = decoder
        self._wanted = Wanted(decisions=lockstep, effects=True, seen=seen, intents=False)
        self._open: dict[int, Pieces] = {}
        self._ended: set[int] = set()
        self._closed = -1  # every episode up to here is over
        self._lost: list[Lost] = []
        self._channels = {
            kind: Channel(kind.value, TYPES[kind], "cdr", "", b"")
            for kind in (Kind.OBSERVATION, Kind.SEEN, Kind.COMMAND)
        }

    @property
    def waiting(self) -> bool:
        """Whether ``take`` may have something."""
        return bool(self._ended or self._lost)

    def start_at(self, number: int) -> None:
        """Nothing of an earlier episode is wanted."""
        self._closed = max(self._closed, number - 1)
        for old in [n for n in self._open if n <= self._closed]:
            self._close(old)

    def add_raw(self, kind: Kind, number: int, step: int, robot: int, data: bytes) -> None:
        pieces = self._pieces(number)
        if pieces is not None:
            name = self._robots[robot]
            pieces.add_raw(kind, (step, robot), name, self._channels[kind], data)

    def add_state(self, state: Any, data: bytes) -> None:
        """An EpisodeState and its serialized form."""
        pieces = self._pieces(state.episode)
        if pieces is None:
            return
        pieces.add_state(state, data)
        if pieces.end is not None:
            self._ended.add(state.episode)

    def add_plan(self, plan: Any) -> None:
        pieces = self._pieces(plan.episode)
        if pieces is not None:
            pieces.add_plan(plan)

    def add_event(self, event: Any) -> None:
        if event.kind != EFFECT or event.robot not in self._robots:
            return
        pieces = self._pieces(event.episode)
        if pieces is not None:
            pieces.add_event(event, self._robots.index(event.robot))

    def _pieces(self, number: int) -> Pieces | None:
        """None for an episode that is over."""
        pieces = self._open.get(number)
        if pieces is not None or number <= self._closed:
            return pieces
        while len(self._open) >= OPEN_EPISODES:
            self.give_up(min(self._open), "newer episodes came before it was complete")
        return self._open.setdefault(number, Pieces(number))

    def give_up(self, number: int, reason: str) -> None:
        """What has come of this episode is all that will come."""
        pieces = self._open.get(number)
        if pieces is None:
            return
        outcome: object = Lost(number, "it has no end")
        if pieces.end is not None:
            outcome = self._assemble(pieces, last=True)
        why = outcome.reason if isinstance(outcome, Lost) else ""
        self._lost.append(Lost(number, f"{reason}: {why}"))
        self._close(number)

    def _close(self, number: int) -> None:
        self._open.pop(number, None)
        self._ended.discard(number)

    def take(self) -> Iterator[RecordedEpisode | Lost]:
        """The episodes that have become complete, or were lost, since the last call."""
        yield from self._lost
        self._lost.clear()
        for number in sorted(self._ended):
            pieces = self._open[number]
            if pieces.end.step and not counts_suffice(pieces, len(self._robots), self._wanted):
                continue
            outcome = self._assemble(pieces, last=False)
            if outcome is not None:
                self._close(number)
                self._closed = max(self._closed, number)
                yield outcome

    def _assemble(self, pieces: Pieces, last: bool) -> RecordedEpisode | Lost | None:
        """None: something is still missing, which may come unless this is the ``last`` try."""
        if pieces.end.step == 0:
            return Lost(pieces.number, "it was cut before its first step")
        try:
            joined = assemble(pieces, self._robots, self._wanted, self._decoder, last=False)
            return recorded_episode(self._name, self._robots, pieces, joined, not self._lockstep)
        except IncompleteError as error:
            if last or pieces.end.truncated:
                return Lost(pieces.number, str(error))
            return None
        except (ContradictionError, UserError, ValueError) as error:
            return Lost(pieces.number, str(error))
