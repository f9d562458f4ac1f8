"""One run on recorded episodes: its loop, its files, its reports; and continuing a killed one."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from policy_pkg.checkpoint import CHECKPOINTS, list_checkpoints
from policy_pkg.learner.learner import DivergedError
from policy_pkg.train.metrics import Value
from policy_pkg.train.offline.config import OfflineConfig
from policy_pkg.train.offline.data import FixedData, Recorded, load_data
from policy_pkg.train.offline.session import OfflineSession
from policy_pkg.train.offline_snapshot import restore, save
from policy_pkg.train.run import REPORT_INTERVAL_S, SPEED_WINDOW_S, MakeEnv, TrainError, keep_batch
from policy_pkg.train.run_dir import locked, prepare_run
from policy_pkg.train.run_log import RunLog
from policy_pkg.train.session import TEST_ARENAS
from policy_pkg.train.snapshot import Logged
from sim_pkg.env import make_env

Phase = Literal["training", "evaluation", "checkpoint", "finished"]


@dataclass(frozen=True)
class OfflineReport:
    """Where a run stands; the callback gets one a few times per second.

    success_crash_free: of the last evaluation block; None where not measured.
    warning: something that the user should know; reported once.
    """

    phase: Phase
    gradient_steps: int
    total_steps: int
    success_crash_free: float | None
    steps_per_s: float
    eta_s: float
    warning: str | None = None


@dataclass(frozen=True)
class OfflineSummary:
    """A finished run. wall_s: of this process."""

    out_dir: Path
    checkpoint: Path
    episodes: int
    gradient_steps: int
    wall_s: float
    last_block: dict[str, Value]


Progress = Callable[[OfflineReport], None]


def read_data(
    config: OfflineConfig, recorded: Iterable[Recorded], environment: MakeEnv = make_env
) -> FixedData:
    """The data set of ``config``: for several runs on the same recordings, read once.

    Raises:
        DataError: recordings, config and scenario do not fit together.
    """
    spec = None if config.scenario is None else environment(config.scenario, 1).spec
    return load_data(recorded, spec, config.memory_limit_mib, config.episode_numbers)


def train_offline(
    config: OfflineConfig,
    data: FixedData,
    out_dir: Path,
    resume: bool = False,
    progress: Progress = lambda report: None,
    clock: Callable[[], float] = time.perf_counter,
    environment: MakeEnv = make_env,
    sources: Sequence[str] = (),
) -> OfflineSummary:
    """Takes ``config.gradient_steps`` on recorded episodes.

    Args:
        data: the data set, which ``read_data`` gave for this config, but for the seed.
        out_dir: becomes the run's directory; missing or empty, unless ``resume`` is set.
        resume: where ``out_dir`` holds a run on the same recordings already, continue it from
            its newest checkpoint, bit for bit as if it had never stopped.
        clock: monotonic, seconds.
        environment: makes the environment of a scenario with a number of arenas.
        sources: where the recordings come from, for ``run.json``.

    Raises:
        UserError: data, config and scenario do not fit together, ``out_dir`` cannot be used,
            a checkpoint is damaged, training diverged, or the result could not be written.
    """
    torch.set_num_threads(1)
    arenas = min(TEST_ARENAS, config.test_episodes)
    env = None if config.scenario is None else environment(config.scenario, arenas)
    session = OfflineSession(config, data, env)
    prepare_run(out_dir, config, resume, describe_data(session, sources))
    with locked(out_dir):
        trainer = _Trainer(session, out_dir, progress, clock)
        try:
            return trainer.run()
        finally:
            trainer.close()


def describe_data(session: OfflineSession, sources: Sequence[str]) -> dict[str, Any]:
    """The data set's part of ``run.json``: what it holds, and how its episodes are weighted."""
    data, weights = session.data, session.weights
    crashed = Counter(data.crashed.tolist())
    return {
        "sources": list(sources),
        "sha256": data.sha256,
        "episodes": len(data),
        "bytes": data.episodes.nbytes,
        "success_rate": data.success_rate,
        "duplicates": data.duplicates,
        "episodes_by_crashed": {str(k): crashed[k] for k in sorted(crashed)},
        "crash_weights": None if weights is None else weights.to_json(),
    }


def warnings(session: OfflineSession) -> list[str]:
    """What the user should know of the data set before learning begins."""
    found = []
    if session.data.duplicates:
        found.append(
            f"{session.data.duplicates} of {len(session.data)} episodes repeat another one "
            "(same seed, number and content): were recordings named twice?"
        )
    if session.weights is not None:
        for lacking in session.weights.unrecorded:
            found.append(
                f"no episode with {lacking.crashed} robots crashed was recorded, but at crash_rate "
                f"{session.config.crash_rate:g} their share is {lacking.target:.3g}: left out"
            )
    return found


class _Trainer:
    """Steps a session and keeps its files."""

    def __init__(
        self,
        session: OfflineSession,
        out_dir: Path,
        progress: Progress,
        clock: Callable[[], float],
    ) -> None:
        self._session, self._out_dir, self._progress = session, out_dir, progress
        self._clock = clock
        found = list_checkpoints(out_dir / CHECKPOINTS)
        self._checkpoint = found[-1] if found else None
        logged = restore(found[-1], session) if found else Logged()
        self._started_s = self._reported_s = clock()
        self._saved = steps = session.gradient_steps
        board = session.config.tensorboard and not session.finished
        self._log = RunLog(out_dir, logged, self._started_s, steps, "gradient_steps", board)
        self._marks = deque([(self._started_s, steps)])

    def run(self) -> OfflineSummary:
        session = self._session
        for warning in warnings(session):
            self._report("training", warning)
        while True:
            # A checkpoint lies behind its block, so a finished run that is resumed has none due.
            if session.block_due and self._block_is_new():
                self._block()
            if session.finished:
                break
            self._step()
        self._report("finished")
        return self._summary()

    def _block_is_new(self) -> bool:
        return self._log.last_block.get("gradient_steps") != self._session.gradient_steps

    def _step(self) -> None:
        try:
            self._session.step()
        except DivergedError as error:
            steps = self._session.gradient_steps
            raise TrainError(keep_batch(self._out_dir, steps, error)) from error
        if self._clock() - self._reported_s >= REPORT_INTERVAL_S:
            self._report("training")

    def _block(self) -> None:
        session = self._session
        self._report("evaluation")
        line, steps = session.end_block(session.test()), session.gradient_steps
        try:
            self._log.write(line, self._clock(), steps)
        except OSError as error:
            self._report("training", f"metrics at {steps} steps wait to be written: {error}")
        due = steps - self._saved
        if due and (due >= session.config.checkpoint_interval_steps or session.finished):
            self._save()

    def _save(self) -> None:
        session, steps = self._session, self._session.gradient_steps
        self._report("checkpoint")
        try:
            self._checkpoint = save(self._out_dir, session, self._log.sync())
            self._saved = steps
        except OSError as error:
            problem = f"checkpoint at {steps} steps was not written: {error}"
            if session.finished:
                raise TrainError(
                    f"{problem}; make room and resume {self._out_dir} to get the result"
                ) from error
            self._report("checkpoint", f"{problem}; the next block tries again")

    def _report(self, phase: Phase, warning: str | None = None) -> None:
        now, steps = self._clock(), self._session.gradient_steps
        total = self._session.config.gradient_steps
        self._reported_s = now
        self._marks.append((now, steps))
        while now - self._marks[0][0] > SPEED_WINDOW_S and len(self._marks) > 2:
            self._marks.popleft()
        since_s, since_steps = self._marks[0]
        speed = (steps - since_steps) / (now - since_s) if now > since_s else 0.0
        success = self._log.last_block.get("success_crash_free")
        report = OfflineReport(
            phase=phase,
            gradient_steps=steps,
            total_steps=total,
            success_crash_free=float(success) if isinstance(success, int | float) else None,
            steps_per_s=speed,
            eta_s=(total - steps) / speed if speed > 0 else 0.0,
            warning=warning,
        )
        self._progress(report)

    def _summary(self) -> OfflineSummary:
        if self._checkpoint is None:
            raise RuntimeError("a finished run has no checkpoint")
        return OfflineSummary(
            out_dir=self._out_dir,
            checkpoint=self._checkpoint,
            episodes=len(self._session.data),
            gradient_steps=self._session.gradient_steps,
            wall_s=self._clock() - self._started_s,
            last_block=self._log.last_block,
        )

    def close(self) -> None:
        self._log.close()
