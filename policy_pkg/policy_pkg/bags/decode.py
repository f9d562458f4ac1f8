"""Serialized messages to objects, by the definitions that the file itself carries."""

from __future__ import annotations

import struct
from typing import Any, Protocol

from rosbags.serde.errors import SerdeError
from rosbags.typesys import (
    Stores,
    TypesysError,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)
from rosbags.typesys.store import Typestore

from crash_coach_common.cdr import body_at, cut_short
from policy_pkg.bags.records import Channel
from policy_pkg.bags.topics import TYPES, Kind

_KEY = struct.Struct("<II")  # episode, step
_MAX_SEQUENCE = 1 << 24
_READ = {
    Kind.OBSERVATION: ("header", "episode", "step", "last_action", "features", "available_actions"),
    Kind.INTENT: ("header", "episode", "step", "action", "fault"),
    Kind.STATE: (
        "header", "episode", "step", "seed", "state", "reward", "terminated", "truncated",
        "success", "crashed", "actions", "trajectory_hash",
    ),
    Kind.PLAN: ("header", "episode", "revision", "seed", "rate", "cap", "faults"),
    Kind.EVENT: ("kind", "episode", "step", "robot", "mode", "intent", "applied"),
}  # fmt: skip
_SAME = {Kind.SEEN: Kind.OBSERVATION, Kind.COMMAND: Kind.INTENT}
_ROS2 = ("ros2msg", "ros2idl", "omgidl")
_BROKEN = (
    struct.error, ValueError, IndexError, TypeError, OverflowError, MemoryError, SerdeError,
)  # fmt: skip


class Decodes(Protocol):
    """What turns the messages of an episode's pieces into objects."""

    def decode(self, channel: Channel, data: bytes) -> Any: ...


class Decoder:
    """For the files of one bag. ``learn`` a channel before decoding what came on it."""

    def __init__(self) -> None:
        self._stores: dict[tuple[str, bytes], Typestore] = {}

    def learn(self, channel: Channel, kind: Kind) -> str | None:
        """Why messages of ``channel`` cannot be read as ``kind``; None: they can."""
        if channel.msgtype != TYPES[kind]:
            return (
                f"topic {channel.topic} has type {channel.msgtype or 'unknown'}, not {TYPES[kind]}"
            )
        if channel.encoding != "cdr":
            return f"topic {channel.topic} is encoded as {channel.encoding!r}, not as cdr"
        try:
            store = self._store(channel)
        except (TypesysError, ValueError, KeyError, SyntaxError) as error:
            why = " ".join(str(error).split())
            return f"topic {channel.topic}: its definition of {channel.msgtype} is wrong: {why}"
        if store is None:
            return f"topic {channel.topic}: the file has no definition of {channel.msgtype}"
        fields = [name for name, _ in store.fielddefs[channel.msgtype][1]]
        wanted = _READ[_SAME.get(kind, kind)]
        missing = [name for name in wanted if name not in fields]
        if missing:
            return f"topic {channel.topic}: {channel.msgtype} has no field {', '.join(missing)}"
        if wanted[:3] == ("header", "episode", "step") and tuple(fields[:3]) != wanted[:3]:
            return f"topic {channel.topic}: {channel.msgtype} does not begin with {wanted[:3]}"
        return None

    def _store(self, channel: Channel) -> Typestore | None:
        key = (channel.msgtype, channel.definition)
        if key not in self._stores:
            if channel.definition_encoding not in _ROS2:
                return None
            text = channel.definition.decode()
            if channel.definition_encoding == "ros2msg":
                types = get_types_from_msg(text, channel.msgtype)
            else:
                types = get_types_from_idl(text)
            store = get_typestore(Stores.EMPTY)
            store.max_sequence_length = _MAX_SEQUENCE
            store.register(types)
            self._stores[key] = store
        return self._stores[key]

    def decode(self, channel: Channel, data: bytes) -> Any:
        """Raises ValueError saying what is wrong with the message."""
        store = self._stores[channel.msgtype, channel.definition]
        try:
            return store.deserialize_cdr(data, channel.msgtype)
        except _BROKEN as error:
            why = " ".join(str(error).split()) or type(error).__name__
            raise ValueError(f"a message of {len(data)} bytes cannot be decoded: {why}") from error


def key_of(data: bytes) -> tuple[int, int]:
    """(episode, step) of a message that begins with header, episode, step; the rest stays as it is.

    Raises:
        UserError: not little-endian CDR, or too short.
    """
    start = body_at("a message", data)
    try:
        episode, step = _KEY.unpack_from(data, start)
    except struct.error as error:
        raise cut_short("a message", data, error) from error
    return episode, step
