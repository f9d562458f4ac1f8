"""The files a run's figures go to, which a resumed run continues without a seam.

``metrics.jsonl`` has one line per evaluation block. Nothing in it depends on the clock, so the
same config and seed give the same file, byte for byte. A value that does not exist is null.

===================  ==========================================================================
key                  meaning
===================  ==========================================================================
env_steps            environment steps so far, all arenas counted, evaluation not
episodes             training episodes finished so far
gradient_steps       updates of the networks so far
epsilon              exploration: probability of a random action, per robot and step
alpha                nominal crash rate of the block, per robot and episode
cap                  most robots that could crash in one episode at that rate
crashed_fraction     share of robots crashed in the training episodes since the last block
success_rate         e_t: successes of the block's greedy episodes, crashes drawn at alpha
return_mean          mean undiscounted team return of the block's episodes
steps_mean           mean length of the block's episodes, in control steps
block_crashed        share of robots crashed in the block's episodes
decision             what the coach did with e_t: raise, lower or keep
new_alpha            nominal crash rate from here on
success_crash_free   success rate of the same episodes without crashes (test_crash_free)
return_crash_free    their mean return
success_worst        success rate under the block's worst condition: ``best/`` goes by it
train_success_rate   success rate of the training episodes since the last block, exploring
train_return_mean    their mean return
train_steps_mean     their mean length, in control steps
loss                 mean squared TD error, mean over the gradient steps since the last block
grad_norm            norm of the joint gradient before clipping, likewise
td_error_abs         mean absolute TD error, likewise
q_taken_mean         mean value of the actions taken, likewise
target_mean          mean TD target, likewise
updates_per_episode  gradient steps per finished episode, as configured
===================  ==========================================================================

With test_victim_episodes there is a key ``success_R_crashed`` for each robot R: the success rate
with it alone crashed. Runs on recordings have ``success_K_crashed`` for so many robots, drawn.

``timing.jsonl`` has one line per block as well: env_steps, wall_s (seconds since this process
began training) and steps_per_s (environment steps per second since the last block, evaluation
included). It differs from run to run.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from crash_coach_common.contract import UserError
from policy_pkg.train.run_dir import METRICS, TIMING

Value = str | int | float | None
UNDER_CRASH = re.compile(r"success_(.+)_crashed")


def crashed_robot(key: str) -> str | None:
    """Whose crash alone the success rate under ``key`` is of; None: of another condition."""
    found = UNDER_CRASH.fullmatch(key)
    return found[1] if found and not found[1].isdecimal() else None


class JsonLines:
    """Appends lines to a file; keeps what a full disk refuses and writes it later.

    Args:
        path: the file; created if missing.
        size_bytes: what lies behind is cut off: lines that a killed run wrote after the
            checkpoint from which it now continues.

    Raises:
        UserError: the file is shorter than ``size_bytes``.
    """

    def __init__(self, path: Path, size_bytes: int) -> None:
        self.path = path
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        found = os.fstat(self._descriptor).st_size
        if found < size_bytes:
            os.close(self._descriptor)
            raise UserError(
                f"{path} has {found} bytes, the checkpoint knows of {size_bytes}: it was changed"
            )
        os.ftruncate(self._descriptor, size_bytes)
        self._size_bytes = size_bytes
        self._pending = b""

    def append(self, values: Mapping[str, Value]) -> None:
        """Adds one line, which ``flush`` writes."""
        self._pending += (json.dumps(values, allow_nan=False) + "\n").encode()

    def flush(self) -> int:
        """Writes what is pending; returns the file's size in bytes.

        Raises:
            OSError: nothing of it was written; it goes out with the next ``flush``.
        """
        end = self._size_bytes
        try:
            while self._pending[end - self._size_bytes :]:
                end += os.pwrite(self._descriptor, self._pending[end - self._size_bytes :], end)
        except OSError:
            os.ftruncate(self._descriptor, self._size_bytes)
            raise
        self._size_bytes, self._pending = end, b""
        return self._size_bytes

    def sync(self) -> int:
        """As ``flush``, and waits until the file is on the disk."""
        size_bytes = self.flush()
        os.fsync(self._descriptor)
        return size_bytes

    def close(self) -> None:
        os.close(self._descriptor)


class Means:
    """Running means by name, until they are taken."""

    def __init__(self) -> None:
        self._sums: dict[str, float] = {}
        self._counts: dict[str, int] = {}

    def add(self, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
            self._counts[name] = self._counts.get(name, 0) + 1

    def take(self, names: tuple[str, ...]) -> dict[str, float | None]:
        """The means of ``names``, None where nothing was added; starts anew."""
        means = {
            name: self._sums[name] / self._counts[name] if name in self._sums else None
            for name in names
        }
        self._sums.clear()
        self._counts.clear()
        return means

    def state_dict(self) -> dict[str, dict[str, float]]:
        return {"sums": dict(self._sums), "counts": {k: float(v) for k, v in self._counts.items()}}

    def load_state_dict(self, state: dict[str, dict[str, float]]) -> None:
        self._sums = dict(state["sums"])
        self._counts = {name: int(count) for name, count in state["counts"].items()}


@dataclass(frozen=True)
class Logged:
    """What the run's log files held when the checkpoint was written."""

    metrics_bytes: int = 0
    timing_bytes: int = 0
    last_block: dict[str, Value] | None = None


class RunLog:
    """``metrics.jsonl`` and ``timing.jsonl``.

    Args:
        out_dir: the run directory.
        logged: what the checkpoint knows of these files; what lies behind is cut off.
        clock_s, step: the clock and the steps done at the start.
        step_key: what steps are called in ``timing.jsonl``.
    """

    def __init__(
        self,
        out_dir: Path,
        logged: Logged,
        clock_s: float,
        step: int,
        step_key: str,
    ) -> None:
        self._metrics = JsonLines(out_dir / METRICS, logged.metrics_bytes)
        self._timing = JsonLines(out_dir / TIMING, logged.timing_bytes)
        self._started_s = self._block_s = clock_s
        self._block_step = step
        self._step_key = step_key
        self.last_block: dict[str, Value] = logged.last_block or {}

    def write(self, line: dict[str, Value], clock_s: float, step: int) -> None:
        """Adds a block's line.

        Raises:
            OSError: it could not be written; the lines go out with the next one.
        """
        spent_s = clock_s - self._block_s
        speed = (step - self._block_step) / spent_s if spent_s > 0 else None
        self._block_s, self._block_step = clock_s, step
        self.last_block = line
        self._metrics.append(line)
        wall_s = clock_s - self._started_s
        self._timing.append({self._step_key: step, "wall_s": wall_s, "steps_per_s": speed})
        self._metrics.flush()
        self._timing.flush()

    def sync(self) -> Logged:
        """Waits until everything is on the disk; returns what a checkpoint has to know.

        Raises:
            OSError: it could not be written.
        """
        return Logged(self._metrics.sync(), self._timing.sync(), self.last_block)

    def close(self) -> None:
        self._metrics.close()
        self._timing.close()
