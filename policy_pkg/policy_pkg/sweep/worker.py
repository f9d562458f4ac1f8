"""The process of one run of a sweep: ``python -m policy_pkg.sweep.worker``.

It reads a Task as one line of JSON from its standard input, which its parent then keeps open: when
that ends, so does this process, however the parent died. What it prints goes to the run's log.
"""

from __future__ import annotations

import os
import shutil
import sys
import threading
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from crash_coach_common.contract import UserError
from crash_coach_common.loading import loading
from policy_pkg.checkpoint import CHECKPOINTS, list_checkpoints
from policy_pkg.sweep.folder import RunFiles, RunProgress, exclusive, write_progress
from policy_pkg.sweep.task import Task
from policy_pkg.train.run_dir import newest_step

if TYPE_CHECKING:
    from policy_pkg.train.progress import ProgressReport

REPLAY = "replay.safetensors"
PROGRESS_INTERVAL_S = 0.5


class _Told:
    """Writes ProgressReports to the run's progress file, not too often."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._last_s = -PROGRESS_INTERVAL_S
        self._warning: str | None = None

    def __call__(self, report: ProgressReport) -> None:
        if report.warning is not None:
            _say(f"warning: {report.warning}")
            self._warning = report.warning
        now_s = time.monotonic()
        if now_s - self._last_s < PROGRESS_INTERVAL_S and report.phase != "finished":
            return
        self._last_s = now_s
        progress = RunProgress(
            env_steps=report.steps,
            total_steps=report.total_steps,
            steps_per_s=report.steps_per_s,
            alpha=report.alpha or 0.0,
            success_rate=report.success_rate,
            warning=self._warning,
        )
        try:
            write_progress(self._path, progress)
        except OSError as error:  # a full disk must not end a run that survives it
            _say(f"warning: {self._path} was not written: {error}")


def _say(text: str) -> None:
    sys.stderr.write(f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S} {text}\n")
    sys.stderr.flush()


def _end_with_parent() -> None:
    while os.read(0, 4096):
        pass
    os._exit(1)


def drop_replay(folder: Path) -> None:
    """Removes what only continuing a run needs and what is large: of a skirmish some 1.5 GB.

    Raises:
        OSError: it could not be removed.
    """
    *older, last = list_checkpoints(folder / CHECKPOINTS)
    for checkpoint in older:
        shutil.rmtree(checkpoint)
    (last / REPLAY).unlink(missing_ok=True)


def perform(task: Task) -> None:
    """Trains the run, or goes on with it, until it is finished.

    Raises:
        UserError: it failed, or another process holds it for longer than ``task.lock_wait_s``.
        OSError: its files cannot be written.
    """
    files = RunFiles(Path(task.out), task.name)
    held = f"{files.folder} is being trained"
    with exclusive(files.lock, task.lock_wait_s, held, lambda: _say(f"waiting: {held}")):
        steps = newest_step(files.folder)
        if steps < task.config.total_steps:
            _say(f"process {os.getpid()} trains {task.name} from step {steps}")
            # Imported here: a process that finds nothing to do needs no torch.
            with loading():
                from policy_pkg.train.run import train

            train(task.config, files.folder, resume=True, progress=_Told(files.progress))
        drop_replay(files.folder)
        _say("finished")


def main() -> int:
    line = sys.stdin.buffer.readline()
    if not line:  # the parent died before it could say anything
        return 1
    task = Task.model_validate_json(line)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sys.argv = task.command  # what run.json keeps as the way to repeat the run
    try:
        perform(task)
    except (UserError, OSError) as error:
        _say(f"error: {error}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
