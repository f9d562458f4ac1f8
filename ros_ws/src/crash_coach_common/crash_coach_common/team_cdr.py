"""Serialized messages of several robots as one: TeamAction and TeamObservation.

Each robot's message stands in it as on the robot's own topic, behind the names of all of them, so
that no part of it need be looked at. Alignment is 4 throughout.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from crash_coach_common.cdr import (
    COMMANDED,
    COUNT,
    ENCAPSULATION_SIZE,
    LITTLE_ENDIAN,
    OBSERVED,
    cut_short,
)
from crash_coach_common.contract import UserError

_STAMP_SIZE = 8
_ENCAPSULATION = LITTLE_ENDIAN + bytes(2)
RobotMessage = tuple[int, bytes]  # a robot's index, and its own serialized message
Layout = Callable[[bytes, int], tuple[tuple[int, ...], int]]  # as ``action_layout``


def _aligned(size: int) -> int:
    return size + 3 & ~3


def _behind_header(data: bytes, at: int) -> int:
    (length,) = COUNT.unpack_from(data, at + _STAMP_SIZE)
    behind: int = at + _STAMP_SIZE + COUNT.size + _aligned(length)
    return behind


def action_layout(data: bytes, at: int) -> tuple[tuple[int, ...], int]:
    """Of the Action that begins at ``at`` where its lengths stand, and where it ends."""
    return (at + _STAMP_SIZE,), _behind_header(data, at) + COMMANDED.size


def observation_layout(data: bytes, at: int) -> tuple[tuple[int, ...], int]:
    """Of the Observation that begins at ``at`` where its lengths stand, and where it ends."""
    features_at = _behind_header(data, at) + OBSERVED.size
    (n_features,) = COUNT.unpack_from(data, features_at)
    available_at = features_at + COUNT.size + 4 * n_features
    (n_actions,) = COUNT.unpack_from(data, available_at)
    return (at + _STAMP_SIZE, features_at, available_at), available_at + COUNT.size + n_actions


def common_step(data: bytes, at: int, count: int) -> tuple[int, int] | None:
    """(episode, step) of ``count`` Actions that begin at ``at``, where they have it in common with
    the whole header, and none claims a fault; None otherwise."""
    try:
        body = _behind_header(data, at)
        episode, step, _, _, _ = COMMANDED.unpack_from(data, body)
    except struct.error:
        return None
    size = body - at + COMMANDED.size
    stride = _aligned(size)
    end = at + stride * (count - 1) + size
    if not end <= len(data) <= _aligned(end):
        return None
    head = data[at : body + 2 * COUNT.size]
    for start in range(at + stride, end, stride):
        if not data.startswith(head, start):
            return None
    faults = data[body + COMMANDED.size - 1 : end : stride]
    return (episode, step) if faults == bytes(count) else None


class _Named(NamedTuple):
    """Whose messages one of several is."""

    names: bytes  # string[], padded
    robots: list[int | None]  # None: nobody's of ours
    upto_ours: int  # so many of the messages hold all of ours


class _Places(NamedTuple):
    """Where ours lie in a message, and in every other that has the same names and lengths: what
    stands behind a length lies where that says."""

    head: bytes  # encapsulation, names and their number
    lengths: struct.Struct  # reads all of them up to the last of ours
    values: tuple[int, ...]
    ours: list[tuple[int, int, int]]  # robot, begin and end
    end: int

    def hold(self, data: bytes) -> bool:
        """Whether this message is such a one."""
        return (
            len(data) >= self.end
            and data.startswith(self.head)
            and self.lengths.unpack_from(data) == self.values
        )


class TeamCodec:
    """Joins and splits the messages of ``robots``.

    Args:
        what: what the messages are called in errors.
        layout: of a robot's message that begins at an offset where its lengths stand and its end.
    """

    def __init__(self, what: str, robots: Sequence[str], layout: Layout) -> None:
        self._what = what
        self._robots = tuple(robots)
        self._all: list[int | None] = list(range(len(robots)))
        self._index = {name: index for index, name in enumerate(robots)}
        self._layout = layout
        self._places: _Places | None = None
        self._written: dict[tuple[int, ...], bytes] = {}  # what stands before some robots' messages
        self._read = _Named(b"", [], 0)
        # Robots that are processes of their own take turns.
        alone = [_Named(_names([name]), [index], 1) for index, name in enumerate(self._robots)]
        self._alone = {named.names: named for named in alone}

    def join(self, messages: Sequence[RobotMessage]) -> bytes:
        """One message of several, each with its robot."""
        robots = tuple(robot for robot, _ in messages)
        head = self._written.get(robots)
        if head is None:
            names = _names(self._robots[robot] for robot in robots)
            head = self._written[robots] = _ENCAPSULATION + names + COUNT.pack(len(robots))
        parts = [head]
        for _, data in messages:
            parts.append(data[ENCAPSULATION_SIZE:])
            parts.append(bytes(-len(data) & 3))
        return b"".join(parts)

    def split(self, data: bytes) -> list[RobotMessage]:
        """The messages of those robots that are ours.

        Raises:
            UserError: not little-endian CDR, cut short up to the last of ours, or not one message
                for each name.
        """
        places = self._places
        ours = places.ours if places is not None and places.hold(data) else self._find(data)
        return [(robot, _ENCAPSULATION + data[begin:end]) for robot, begin, end in ours]

    def _find(self, data: bytes) -> list[tuple[int, int, int]]:
        """Robot, begin and end of each message that is ours."""
        if data[:2] != LITTLE_ENDIAN:
            raise UserError(
                f"{self._what}: encapsulation {data[:2].hex()} is not little-endian CDR"
            )
        ours: list[tuple[int, int, int]] = []
        lengths_at: list[int] = []
        try:
            named, begin = self._named(data)
            end = begin
            for robot in named.robots[: named.upto_ours]:
                at = _aligned(end)
                found, end = self._layout(data, at)
                lengths_at += found
                if robot is not None:
                    ours.append((robot, at, end))
        except (struct.error, UnicodeDecodeError) as error:
            raise cut_short(self._what, data, error) from error
        if end > len(data):
            raise UserError(f"{self._what} of {len(data)} bytes is cut short")
        if len(named.robots) > 1:  # processes of one robot each take turns
            lengths = _all_of(lengths_at)
            self._places = _Places(data[:begin], lengths, lengths.unpack_from(data), ours, end)
        return ours

    def begin_of_all(self, data: bytes) -> int | None:
        """Where the messages begin in one of all robots, in their order; None for any other."""
        try:
            if COUNT.unpack_from(data, ENCAPSULATION_SIZE) != (len(self._all),):
                return None
            named, at = self._named(data)
        except (UserError, struct.error, UnicodeDecodeError):
            return None  # for ``split`` to say what is wrong
        return at if named.robots == self._all and data[:2] == LITTLE_ENDIAN else None

    def _named(self, data: bytes) -> tuple[_Named, int]:
        """Whose messages these are, and where their number ends."""
        named = self._read
        if not named.names or not data.startswith(named.names, ENCAPSULATION_SIZE):
            named = self._alone.get(_first_name(data)) or self._names_read(data)
        end = ENCAPSULATION_SIZE + len(named.names)
        (count,) = COUNT.unpack_from(data, end)
        if count != len(named.robots):
            raise UserError(f"{self._what}: {count} messages for {len(named.robots)} robots")
        return named, end + COUNT.size

    def _names_read(self, data: bytes) -> _Named:
        found, end = _names_of(data, ENCAPSULATION_SIZE)
        robots = [self._index.get(name) for name in found]
        ours = [place for place, robot in enumerate(robots) if robot is not None]
        upto_ours = ours[-1] + 1 if ours else 0
        self._read = _Named(data[ENCAPSULATION_SIZE:end], robots, upto_ours)
        return self._read


def _all_of(counts_at: Sequence[int]) -> struct.Struct:
    """Reads the COUNTs that stand there, of which each lies behind the one before."""
    behind = [0, *(at + COUNT.size for at in counts_at)]
    gaps = [at - since for at, since in zip(counts_at, behind, strict=False)]
    return struct.Struct("<" + "".join(f"{gap}xI" for gap in gaps))


def _names(names: Iterable[str]) -> bytes:
    """string[], padded."""
    encoded = [name.encode() + b"\0" for name in names]
    parts = [COUNT.pack(len(encoded))]
    for text in encoded:
        parts += [COUNT.pack(len(text)), text, bytes(-len(text) & 3)]
    return b"".join(parts)


def _first_name(data: bytes) -> bytes:
    """``names`` of a message of one robot; of others' the beginning of that."""
    at = ENCAPSULATION_SIZE + COUNT.size
    (length,) = COUNT.unpack_from(data, at)
    return data[ENCAPSULATION_SIZE : at + COUNT.size + _aligned(length)]


def _names_of(data: bytes, at: int) -> tuple[list[str], int]:
    """A string[] and where it ends, padded."""
    (count,) = COUNT.unpack_from(data, at)
    at += COUNT.size
    names = []
    for _ in range(count):
        (length,) = COUNT.unpack_from(data, at)
        at += COUNT.size
        names.append(data[at : at + length].rstrip(b"\0").decode())
        at += _aligned(length)
    return names, at
