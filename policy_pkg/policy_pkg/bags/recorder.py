"""From callbacks to the file: a bounded queue and the thread that writes."""

from __future__ import annotations

import struct
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

from rosbags.typesys.store import Typestore

from policy_pkg.bags.topics import EPISODE_TOPIC, TYPES, Connection, Kind
from policy_pkg.bags.writer import BagWriter

_STAMP = struct.Struct("<iI")  # after the encapsulation, where a message begins with a time
_STAMP_AT = 4
_NS_PER_S = 1_000_000_000
_PAUSE_S = 0.05  # how long messages gather before the thread wakes for them


class Recorder:
    """``put`` takes messages as fast as they come; one thread writes them.

    What does not fit the queue is dropped and counted by topic, in ``drops`` and in the file; so is
    what the middleware says it lost.

    Args:
        writer: used by this recorder's thread alone from here on.
        queue_messages: most messages that may wait.
        now_ns: time of reception, nanoseconds since the epoch.
    """

    def __init__(
        self,
        writer: BagWriter,
        connections: tuple[Connection, ...],
        typestore: Typestore,
        queue_messages: int,
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._writer = writer
        self._connections = connections
        self._typestore = typestore
        self._capacity = queue_messages
        self._now_ns = now_ns
        self._queue: deque[tuple[int, int, bytes]] = deque()
        self._dropped: Counter[int] = Counter()
        self._closing = threading.Event()
        self._states = next(
            (i for i, c in enumerate(connections) if c.topic == EPISODE_TOPIC), None
        )
        self._ended: set[tuple[int, int]] = set()
        self.failure: OSError | None = None
        """Why nothing is written any more (a full disk, for one)."""
        self._thread = threading.Thread(target=self._work, name="bag writer")
        self._thread.start()

    def put(self, connection: int, data: bytes) -> None:
        """A serialized message on ``connections[connection]``, just received."""
        if len(self._queue) >= self._capacity:
            self._dropped[connection] += 1
        else:
            self._queue.append((connection, self._now_ns(), data))

    def lost(self, connection: int, count: int) -> None:
        """The middleware tells that messages were lost before they came here."""
        self._dropped[connection] += count

    @property
    def drops(self) -> dict[str, int]:
        """Messages that found the queue full or were lost on their way here, by topic."""
        dropped = dict(self._dropped)  # copied at once: ``put`` may run meanwhile
        return {self._connections[i].topic: n for i, n in sorted(dropped.items())}

    @property
    def episodes(self) -> int:
        """Episodes whose end was recorded."""
        return len(self._ended)

    @property
    def messages(self) -> int:
        return self._writer.messages

    def close(self) -> None:
        """Writes what waits, then ends the file.

        Raises:
            OSError: the recording could not be written to its end.
        """
        self._closing.set()
        self._thread.join()
        if self.failure is not None:
            raise self.failure

    def _work(self) -> None:
        try:
            while not self._closing.wait(_PAUSE_S):
                self._drain()
                self._writer.tick()
            self._drain()
            self._writer.lost(self.drops)
            self._writer.close()
        except OSError as error:
            self.failure = error

    def _drain(self) -> None:
        queue, write = self._queue, self._writer.write
        for _ in range(len(queue)):  # no more than waits now: what comes meanwhile must not keep it
            connection, received_ns, data = queue.popleft()
            write(connection, received_ns, stamp_ns(data, received_ns), data)
            if connection == self._states:
                self._note_end(data)
        self._writer.lost(self.drops)

    def _note_end(self, data: bytes) -> None:
        state: Any = self._typestore.deserialize_cdr(data, TYPES[Kind.STATE])
        key = (state.seed, state.episode)
        if (state.terminated or state.truncated) and key not in self._ended:
            self._ended.add(key)
            self._writer.episode_ended()


def stamp_ns(data: bytes, received_ns: int) -> int:
    """The time that every recorded type begins with; received_ns where there is none."""
    if len(data) < _STAMP_AT + _STAMP.size:
        return received_ns
    seconds, nanoseconds = _STAMP.unpack_from(data, _STAMP_AT)
    stamp_ns: int = seconds * _NS_PER_S + nanoseconds
    return max(stamp_ns, 0)
