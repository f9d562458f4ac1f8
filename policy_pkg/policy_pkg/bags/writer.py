"""Writes a rosbag2 MCAP recording that survives the end of its writer at any moment."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

from mcap.writer import CompressionType, Writer
from rosbags.typesys.store import Typestore

from crash_coach_common.contract import UserError
from policy_pkg.bags.about import RECORD, About
from policy_pkg.bags.topics import Connection

COMPRESSIONS = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "none": CompressionType.NONE,
}
METADATA_FILE = "metadata.yaml"
_PARTIAL = f"{METADATA_FILE}.partial"
_METADATA_VERSION = 9
_LIBRARY = "crash_coach recorder"


@dataclass(frozen=True)
class Split:
    """When a recording goes on in a new file; 0: not for that reason."""

    bytes: int = 0
    episodes: int = 0


@dataclass
class _File:
    name: str
    first_ns: int = 0
    last_ns: int = 0
    counts: dict[int, int] = field(default_factory=dict)  # by connection

    def count(self, connection: int, log_time_ns: int) -> None:
        self.first_ns = min(self.first_ns, log_time_ns) if self.counts else log_time_ns
        self.last_ns = max(self.last_ns, log_time_ns)
        self.counts[connection] = self.counts.get(connection, 0) + 1

    @property
    def messages(self) -> int:
        return sum(self.counts.values())


class BagWriter:
    """A folder with NAME_0.mcap, NAME_1.mcap, ... and metadata.yaml. For one thread.

    Whole chunks reach the system at least every ``flush_s``, if ``tick`` is called that often; a
    process that is killed loses at most what came after. A chunk carries a CRC.

    Args:
        folder: made here; must not exist, or be empty.
        clock: a steady clock, seconds.

    Raises:
        UserError: the folder is in use, or cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        connections: Sequence[Connection],
        typestore: Typestore,
        about: About,
        clock: Callable[[], float],
        split: Split | None = None,
        compression: str = "zstd",
        flush_s: float = 0.5,
    ) -> None:
        if compression not in COMPRESSIONS:
            raise UserError(f"compression {compression!r}: one of {', '.join(COMPRESSIONS)}")
        self._folder = folder
        self._connections = tuple(connections)
        self._definitions = {
            c.msgtype: (
                typestore.generate_msgdef(c.msgtype, ros_version=2)[0],
                typestore.hash_rihs01(c.msgtype),
            )
            for c in self._connections
        }
        self.about = about
        self._clock = clock
        self._split = split or Split()
        self._compression = compression
        self._flush_s = flush_s
        self._files: list[_File] = []
        self._episodes = 0  # ended in this file
        self._full = False  # the next message begins a new file
        _make(folder)
        try:
            self._open()
        except FileExistsError:  # of another recording, which began here at the same moment
            raise _used(folder) from None
        except OSError as error:
            self._abandon()
            raise UserError(f"{folder}: {error.strerror}") from error

    @property
    def messages(self) -> int:
        """Written so far."""
        return sum(file.messages for file in self._files)

    def write(self, connection: int, log_time_ns: int, publish_time_ns: int, data: bytes) -> None:
        """One serialized message on ``connections[connection]``."""
        if self._full:
            self._finish()
            self._open()
        file = self._files[-1]
        file.count(connection, log_time_ns)
        self._writer.add_message(
            self._channels[connection],
            log_time_ns,
            data,
            publish_time_ns,
            file.counts[connection] - 1,
        )
        if self._split.bytes and self._stream.tell() >= self._split.bytes:
            self._full = True

    def episode_ended(self) -> None:
        self._episodes += 1
        if self._split.episodes and self._episodes >= self._split.episodes:
            self._full = True

    def tick(self) -> None:
        """Flushes when it is due; to be called often, also while nothing comes."""
        if self._clock() - self._flushed_s >= self._flush_s:
            self._flush()

    def lost(self, drops: Mapping[str, int]) -> None:
        """Notes in the file that messages were lost before they came here (totals by topic)."""
        if dict(drops) != dict(self.about.drops):
            self.about = replace(self.about, drops=dict(drops))
            self._writer.add_metadata(RECORD, self.about.to_record())

    def close(self) -> None:
        self._finish()
        self._write_metadata()

    def _flush(self) -> None:
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._flushed_s = self._clock()

    def _open(self) -> None:
        name = self._name(len(self._files))
        self._stream: BinaryIO = (self._folder / name).open("xb")
        # Data CRC: what is not in chunks (the records about the recording) is protected too.
        self._writer = Writer(
            self._stream, compression=COMPRESSIONS[self._compression], enable_data_crcs=True
        )
        self._writer.start(profile="ros2", library=_LIBRARY)
        self._writer.add_metadata(RECORD, self.about.to_record())
        schemas = {
            msgtype: self._writer.register_schema(msgtype, "ros2msg", text.encode())
            for msgtype, (text, _) in self._definitions.items()
        }
        self._channels = [
            self._writer.register_channel(
                c.topic,
                "cdr",
                schemas[c.msgtype],
                {
                    "offered_qos_profiles": json.dumps([_qos(c)]),
                    "topic_type_hash": self._definitions[c.msgtype][1],
                },
            )
            for c in self._connections
        ]
        self._files.append(_File(name))
        self._episodes = 0
        self._full = False
        self._flush()
        self._write_metadata()

    def _abandon(self) -> None:
        """A recording that could not be begun leaves nothing of its own in its folder."""
        own = {self._name(0), _PARTIAL, METADATA_FILE}
        for path in self._folder.iterdir():
            if path.name in own:
                path.unlink()

    def _name(self, number: int) -> str:
        return f"{self._folder.name}_{number}.mcap"

    def _finish(self) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()

    def _write_metadata(self) -> None:
        """metadata.yaml as rosbag2 wants it. JSON is YAML, and needs no further library."""
        partial = self._folder / _PARTIAL
        partial.write_text(json.dumps({"rosbag2_bagfile_information": self._metadata()}, indent=1))
        os.replace(partial, self._folder / METADATA_FILE)

    def _metadata(self) -> dict[str, Any]:
        filled = [file for file in self._files if file.messages]
        first = min((file.first_ns for file in filled), default=0)
        last = max((file.last_ns for file in filled), default=0)
        counts = [
            sum(file.counts.get(index, 0) for file in self._files)
            for index in range(len(self._connections))
        ]
        return {
            "version": _METADATA_VERSION,
            "storage_identifier": "mcap",
            "duration": {"nanoseconds": last - first},
            "starting_time": {"nanoseconds_since_epoch": first},
            "message_count": sum(counts),
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": c.topic,
                        "type": c.msgtype,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": [_qos(c)],
                        "type_description_hash": self._definitions[c.msgtype][1],
                    },
                    "message_count": count,
                }
                for c, count in zip(self._connections, counts, strict=True)
            ],
            # Chunks are compressed within the storage, which rosbag2 does not count as compression.
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [file.name for file in self._files],
            "files": [
                {
                    "path": file.name,
                    "starting_time": {"nanoseconds_since_epoch": file.first_ns},
                    "duration": {"nanoseconds": file.last_ns - file.first_ns},
                    "message_count": file.messages,
                }
                for file in self._files
            ],
            "custom_data": self.about.to_record(),
            "ros_distro": "jazzy",
        }


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        used = any(folder.iterdir())
    except OSError as error:
        raise UserError(f"{folder}: {error.strerror}") from error
    if used:
        raise _used(folder)


def _used(folder: Path) -> UserError:
    return UserError(f"{folder} is not empty: a recording needs a folder of its own")


def _qos(connection: Connection) -> dict[str, Any]:
    qos = connection.qos()
    return {
        "history": qos.history.name.lower(),
        "depth": qos.depth,
        "reliability": qos.reliability.name.lower(),
        "durability": qos.durability.name.lower(),
        "deadline": {"sec": qos.deadline.sec, "nsec": qos.deadline.nsec},
        "lifespan": {"sec": qos.lifespan.sec, "nsec": qos.lifespan.nsec},
        "liveliness": qos.liveliness.name.lower(),
        "liveliness_lease_duration": {
            "sec": qos.liveliness_lease_duration.sec,
            "nsec": qos.liveliness_lease_duration.nsec,
        },
        "avoid_ros_namespace_conventions": False,
    }
