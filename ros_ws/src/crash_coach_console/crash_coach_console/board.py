"""What pages are shown of a source: the newest value of each topic, and a log of events.

A page asks for what is newer than what it has. So nothing is queued for anybody: a page that reads
slowly skips values, one that does not read costs nothing, and whoever posts never waits.
"""

from __future__ import annotations

import json
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

KEPT_EVENTS = 200


@dataclass
class Cursor:
    """What a page has: the version of each topic, and the number of the last event."""

    versions: dict[str, int] = field(default_factory=dict)
    event: int = 0


class Board:
    """Thread-safe. ``source``: the number under which pages know it."""

    def __init__(self, source: int) -> None:
        self._source = source
        self._lock = threading.Lock()
        self._values: dict[str, tuple[int, Mapping[str, Any] | str]] = {}
        self._events: deque[Mapping[str, Any]] = deque(maxlen=KEPT_EVENTS)
        self._event = 0

    def post(self, topic: str, value: Mapping[str, Any]) -> None:
        """The newest value of ``topic``; JSON values only, never changed afterwards."""
        with self._lock:
            version, _ = self._values.get(topic, (0, ""))
            self._values[topic] = (version + 1, value)

    def log(self, event: Mapping[str, Any]) -> None:
        """Another event; the oldest is forgotten."""
        with self._lock:
            self._events.append(event)
            self._event += 1

    def since(self, cursor: Cursor) -> list[str]:
        """Messages of what is newer than ``cursor``, which then stands at the newest."""
        out = []
        with self._lock:
            for topic, (version, value) in self._values.items():
                if cursor.versions.get(topic) == version:
                    continue
                if not isinstance(value, str):  # encoded once, for whoever asks first
                    value = self._encode(topic, value)
                    self._values[topic] = (version, value)
                out.append(value)
                cursor.versions[topic] = version
            missed = self._event - cursor.event
            if missed > 0:
                newest = list(self._events)[-missed:]
                out.append(self._encode("events", {"entries": newest}))
                cursor.event = self._event
        return out

    def _encode(self, topic: str, value: Mapping[str, Any]) -> str:
        return json.dumps(
            {"type": topic, "source": self._source, **value}, separators=(",", ":"), allow_nan=False
        )
