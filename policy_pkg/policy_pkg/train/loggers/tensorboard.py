"""The metrics as TensorBoard events."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from policy_pkg.train.loggers.base import ExperimentLogger, NoOptions, Start, Status

if TYPE_CHECKING:
    from policy_pkg.train.metrics import Value

FOLDER = "tensorboard"


class TensorBoard(ExperimentLogger):
    """Writes every number of a metrics line under its key, to the run's folder ``tensorboard``."""

    def __init__(self, start: Start, options: NoOptions) -> None:
        # Imported here: whoever only reads a configuration need not wait for it.
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog
        from tensorboard.compat.proto.summary_pb2 import Summary
        from tensorboard.summary.writer.event_file_writer import EventFileWriter

        self._event, self._summary = Event, Summary
        self._writer = EventFileWriter(str(start.out_dir / FOLDER))
        # Hides what a killed run wrote of later steps.
        self._add(start.step, session_log=SessionLog(status=SessionLog.START))

    def _add(self, step: int, **content: Any) -> None:
        self._writer.add_event(self._event(wall_time=time.time(), step=step, **content))

    def log_metrics(self, line: Mapping[str, Value], step: int) -> None:
        for key, value in line.items():
            if isinstance(value, int | float) and key != "env_steps":
                scalar = self._summary.Value(tag=key, simple_value=value)
                self._add(step, summary=self._summary(value=[scalar]))
        self._writer.flush()

    def finalize(self, status: Status) -> None:
        self._writer.close()
