"""One run as its parent sees it: what the process is told, how it is watched and ended."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from crash_coach_common.strict_yaml import StrictModel
from policy_pkg.sweep.folder import RunFiles
from policy_pkg.train.config import TrainConfig

TAIL_LINES = 12
STOP_S = 10.0
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Task(StrictModel):
    """What a run's process needs to know.

    Args:
        out: the sweep's folder, absolute.
        cwd: what relative paths of scenarios are relative to.
        command: of the sweep, for run.json.
        lock_wait_s: how long the run's lock may be held by a process that is about to die.
    """

    name: str
    config: TrainConfig
    out: str
    cwd: str
    command: list[str]
    lock_wait_s: float


class Child:
    """The process of one run.

    Raises:
        OSError: the log cannot be written, or no process started.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        self._files = RunFiles(Path(task.out), task.name)
        with self._files.log.open("ab") as log:
            self._log_from = log.tell()
            self._process = subprocess.Popen(
                [sys.executable, "-m", "policy_pkg.sweep.worker"],
                stdin=subprocess.PIPE,  # kept open as long as this process lives
                stdout=log,
                stderr=log,
                env={**os.environ, **dict.fromkeys(THREADS, "1")},
                cwd=task.cwd,
                process_group=0,  # Ctrl-C is for the sweep alone
            )
        if self._process.stdin is not None:
            with suppress(BrokenPipeError):  # it died at once: poll tells
                self._process.stdin.write(task.model_dump_json().encode() + b"\n")
                self._process.stdin.flush()

    def poll(self) -> int | None:
        """The exit code, or None while it runs."""
        return self._process.poll()

    def wait(self) -> int:
        """Until it ends; its exit code."""
        return self._process.wait()

    def failure(self) -> str:
        """Why it ended: the end of what it wrote, and where all of it is."""
        code = self._process.returncode
        what = f"exit code {code}" if code >= 0 else f"signal {signal.Signals(-code).name}"
        with self._files.log.open("rb") as log:
            log.seek(self._log_from)
            lines = log.read().decode(errors="replace").splitlines()
        tail = "\n".join(f"    {line}" for line in lines[-TAIL_LINES:])
        return f"{what}; see {self._files.log}, which ends with:\n{tail}"

    def terminate(self) -> None:
        """Asks it to end; what it did since its last checkpoint is lost."""
        self._process.terminate()

    def stop(self) -> None:
        """Ends it within ``STOP_S``."""
        self.terminate()
        try:
            self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
