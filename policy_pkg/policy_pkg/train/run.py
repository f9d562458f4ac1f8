"""One training run: its loop, its files, its reports; and continuing one that was killed."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from safetensors import SafetensorError
from safetensors.numpy import save_file

from crash_coach_common.contract import BatchEnv, UserError
from policy_pkg.checkpoint import CHECKPOINTS, list_checkpoints
from policy_pkg.learner.learner import DivergedError
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.metrics import Value
from policy_pkg.train.run_dir import locked, prepare_run
from policy_pkg.train.run_log import RunLog
from policy_pkg.train.session import TEST_ARENAS, Session
from policy_pkg.train.snapshot import Logged, restore, save, save_best
from sim_pkg.env import make_env

Phase = Literal["training", "evaluation", "checkpoint", "finished"]
Clock = Callable[[], float]
MakeEnv = Callable[[str | Path, int], BatchEnv]

REPORT_INTERVAL_S = 0.2
SPEED_WINDOW_S = 10.0


class TrainError(UserError):
    """Training stopped: it diverged, or its result could not be written."""


@dataclass(frozen=True)
class ProgressReport:
    """Where a run stands; from the first step on, the callback gets one a few times per second.

    success_rate, success_crash_free: of the last evaluation block; None where not measured.
    steps_per_s, eta_s: from the last seconds; 0 for a finished run that was resumed.
    warning: something that went wrong and was survived; reported once.
    """

    phase: Phase
    env_steps: int
    total_steps: int
    alpha: float
    epsilon: float
    success_rate: float | None
    success_crash_free: float | None
    steps_per_s: float
    eta_s: float
    warning: str | None = None


@dataclass(frozen=True)
class TrainSummary:
    """A finished run. wall_s: of this process, 0 where the run was finished already."""

    out_dir: Path
    checkpoint: Path
    env_steps: int
    episodes: int
    gradient_steps: int
    alpha: float
    wall_s: float
    last_block: dict[str, Value]


def train(
    config: TrainConfig,
    out_dir: Path,
    resume: bool = False,
    progress: Callable[[ProgressReport], None] = lambda report: None,
    clock: Clock = time.perf_counter,
    environment: MakeEnv = make_env,
    opened: Callable[[Session], None] = lambda session: None,
) -> TrainSummary:
    """Trains until ``config.total_steps``.

    Args:
        out_dir: becomes the run's directory; missing or empty, unless ``resume`` is set.
        resume: where ``out_dir`` holds a run already, continue it from its newest checkpoint,
            bit for bit as if it had never stopped.
        clock: monotonic, seconds.
        environment: makes the environment of a scenario with a number of arenas.
        opened: told the session before its first step.

    Raises:
        UserError: the config does not fit the scenario, ``out_dir`` cannot be used, a checkpoint
            is damaged, training diverged, or the result could not be written.
    """
    torch.set_num_threads(1)  # a second core is better used by a second run
    env = environment(config.scenario, config.n_envs)
    test_env = environment(config.scenario, min(TEST_ARENAS, config.test_episodes))
    session = Session(config, env, test_env)
    prepare_run(out_dir, config, resume)
    with locked(out_dir):
        trainer = _Trainer(session, out_dir, progress, clock)
        try:
            opened(session)
            return trainer.run()
        finally:
            trainer.close()


class _Trainer:
    """Steps a session and keeps its files."""

    def __init__(
        self,
        session: Session,
        out_dir: Path,
        progress: Callable[[ProgressReport], None],
        clock: Clock,
    ) -> None:
        self._session = session
        self._out_dir = out_dir
        self._progress = progress
        self._clock = clock
        found = list_checkpoints(out_dir / CHECKPOINTS)
        self._checkpoint = found[-1] if found else None
        logged = restore(found[-1], session) if found else Logged()
        self._saved_steps = steps = session.counters.env_steps
        self._started_s = self._reported_s = clock()
        board = session.config.tensorboard and not session.finished
        self._log = RunLog(out_dir, logged, self._started_s, steps, "env_steps", board)
        self._marks = deque([(self._started_s, steps)])
        self._warning: str | None = None

    def run(self) -> TrainSummary:
        session = self._session
        while True:
            # A checkpoint lies behind its block, so a finished run that is resumed has none due.
            if session.block_due and self._block_is_new():
                self._block()
            if session.finished:
                break
            self._collect()
        self._report("finished")
        return self._summary()

    def _block_is_new(self) -> bool:
        return self._log.last_block.get("env_steps") != self._session.counters.env_steps

    def _collect(self) -> None:
        try:
            self._session.collect()
        except DivergedError as error:
            steps = self._session.counters.env_steps
            raise TrainError(keep_batch(self._out_dir, steps, error)) from error
        if self._clock() - self._reported_s >= REPORT_INTERVAL_S:
            self._report("training")

    def _block(self) -> None:
        session = self._session
        self._report("evaluation")
        line, steps = session.end_block(session.test()), session.counters.env_steps
        try:
            self._log.write(line, self._clock(), steps)
        except OSError as error:
            self._report("training", f"metrics at {steps} steps wait to be written: {error}")
        if session.best_is_now:
            self._save_best()
        due = steps - self._saved_steps
        if due and (due >= session.config.checkpoint_interval_steps or session.finished):
            self._save()

    def _save_best(self) -> None:
        try:
            save_best(self._out_dir, self._session)
        except OSError as error:
            problem = f"the best checkpoint, at {self._session.counters.env_steps} steps,"
            self._report("evaluation", f"{problem} was not written: {error}")

    def _save(self) -> None:
        session, steps = self._session, self._session.counters.env_steps
        self._report("checkpoint")
        try:
            self._checkpoint = save(self._out_dir, session, self._log.sync())
            self._saved_steps = steps
        except OSError as error:
            problem = f"checkpoint at {steps} steps was not written: {error}"
            if session.finished:
                raise TrainError(
                    f"{problem}; make room and resume {self._out_dir} to get the result"
                ) from error
            self._report("checkpoint", f"{problem}; the next block tries again")

    def _report(self, phase: Phase, warning: str | None = None) -> None:
        session, now = self._session, self._clock()
        self._reported_s = now
        self._warning = warning or self._warning
        steps, total = session.counters.env_steps, session.config.total_steps
        self._marks.append((now, steps))
        while now - self._marks[0][0] > SPEED_WINDOW_S and len(self._marks) > 2:
            self._marks.popleft()
        since_s, since_steps = self._marks[0]
        moving = now > since_s and steps > since_steps
        if not moving and not session.finished:
            return
        speed = (steps - since_steps) / (now - since_s) if moving else 0.0
        report = ProgressReport(
            phase=phase,
            env_steps=steps,
            total_steps=total,
            alpha=session.coach.rate,
            epsilon=session.config.epsilon(steps),
            success_rate=_number(self._log.last_block.get("success_rate")),
            success_crash_free=_number(self._log.last_block.get("success_crash_free")),
            steps_per_s=speed,
            eta_s=max(0, total - steps) / speed if moving else 0.0,
            warning=self._warning,
        )
        self._warning = None
        self._progress(report)

    def _summary(self) -> TrainSummary:
        session, done = self._session, self._session.counters
        if self._checkpoint is None:
            raise RuntimeError("a finished run has no checkpoint")
        return TrainSummary(
            out_dir=self._out_dir,
            checkpoint=self._checkpoint,
            env_steps=done.env_steps,
            episodes=done.episodes,
            gradient_steps=session.learner.updates,
            alpha=session.coach.rate,
            wall_s=self._clock() - self._started_s,
            last_block=self._log.last_block,
        )

    def close(self) -> None:
        self._log.close()


def keep_batch(out_dir: Path, steps: int, error: DivergedError) -> str:
    """Saves the batch that made the learner diverge; returns what to tell."""
    path = out_dir / f"diverged_{steps:09d}.safetensors"
    try:
        save_file(error.batch.arrays(), path)
    except (OSError, SafetensorError) as failure:
        return f"training in {out_dir}: {error}; the batch was not saved: {failure}"
    return f"training in {out_dir}: {error}; the batch is in {path}"


def _number(value: Value) -> float | None:
    return float(value) if isinstance(value, int | float) else None
