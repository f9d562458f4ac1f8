"""The metrics as TensorBoard events."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.event_file_writer import EventFileWriter


class TensorBoard:
    """Writes every number of a metrics line under its key.

    purge_step: events from this step on, of a killed run, are hidden.
    """

    def __init__(self, folder: Path, purge_step: int) -> None:
        self._writer = EventFileWriter(str(folder))
        start = SessionLog(status=SessionLog.START)
        self._writer.add_event(self._event(purge_step, session_log=start))

    def _event(self, step: int, **content: Any) -> Event:
        return Event(wall_time=time.time(), step=step, **content)

    def write(self, line: Mapping[str, object], step: int) -> None:
        """Raises OSError where events could not be written."""
        for key, value in line.items():
            if isinstance(value, int | float) and key != "env_steps":
                scalar = Summary.Value(tag=key, simple_value=value)
                self._writer.add_event(self._event(step, summary=Summary(value=[scalar])))
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()
