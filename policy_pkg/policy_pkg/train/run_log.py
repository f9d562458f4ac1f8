"""The files that a run's evaluation blocks go to, continued without a seam by a resumed run."""

from __future__ import annotations

from pathlib import Path

from policy_pkg.train.metrics import JsonLines, Value
from policy_pkg.train.run_dir import METRICS, TENSORBOARD, TIMING
from policy_pkg.train.snapshot import Logged
from policy_pkg.train.tensorboard import TensorBoard


class RunLog:
    """``metrics.jsonl``, ``timing.jsonl`` and, where asked for, TensorBoard's events.

    Args:
        out_dir: the run directory.
        logged: what the checkpoint knows of these files; what lies behind is cut off.
        clock_s, step: the clock and the steps done at the start.
        step_key: what steps are called in ``timing.jsonl``.
        tensorboard: whether to write events.
    """

    def __init__(
        self,
        out_dir: Path,
        logged: Logged,
        clock_s: float,
        step: int,
        step_key: str,
        tensorboard: bool,
    ) -> None:
        self._metrics = JsonLines(out_dir / METRICS, logged.metrics_bytes)
        self._timing = JsonLines(out_dir / TIMING, logged.timing_bytes)
        self._board = TensorBoard(out_dir / TENSORBOARD, step) if tensorboard else None
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
        if self._board is not None:
            self._board.write(line, step)

    def sync(self) -> Logged:
        """Waits until everything is on the disk; returns what a checkpoint has to know.

        Raises:
            OSError: it could not be written.
        """
        return Logged(self._metrics.sync(), self._timing.sync(), self.last_block)

    def close(self) -> None:
        self._metrics.close()
        self._timing.close()
        if self._board is not None:
            self._board.close()
