"""One training run: its loop, its files, its reports; and continuing one that was killed.

There is one loop. What is learned from differs, and with it the session: episodes that are played
in this process, episodes that graphs play, recordings.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Protocol, Self

from safetensors import SafetensorError
from safetensors.numpy import save_file

from crash_coach_common.contract import BatchEnv, UserError
from policy_pkg.checkpoint import CHECKPOINTS, list_checkpoints
from policy_pkg.learner.learner import DivergedError
from policy_pkg.learner.threads import use_one_thread
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.loggers import Chosen
from policy_pkg.train.loggers.base import Start, Status
from policy_pkg.train.metrics import Logged, RunLog, Value
from policy_pkg.train.progress import OnProgress, Phase, ProgressReport, RunSummary, silent
from policy_pkg.train.run_dir import (
    RunConfig,
    extend_run,
    flat,
    kept_scenario,
    locked,
    prepare_run,
    read_run,
)
from policy_pkg.train.session import TEST_ARENAS, TrainSession
from policy_pkg.train.snapshot import Saved, restore, save, save_best
from sim_pkg.env import ScenarioLike, make_any_env
from sim_pkg.scenario_source import ScenarioSource

Clock = Callable[[], float]
MakeEnv = Callable[[ScenarioLike, int], BatchEnv]

REPORT_INTERVAL_S = 0.2
SPEED_WINDOW_S = 10.0


class EndedEarly(Exception):
    """A run was asked to end before its last step; resuming it goes on from its checkpoint."""


class TrainError(UserError):
    """Training stopped: it diverged, or its result could not be written."""


class Session(Saved, Protocol):
    """All of a run that changes while it runs; knows nothing of files.

    ``STEPS``: what its steps are called in ``metrics.jsonl``. ``alpha``, ``epsilon``: the nominal
    crash rate and the exploration now; None where the session decides neither.
    """

    STEPS: ClassVar[str]

    @property
    def config(self) -> RunConfig: ...
    @property
    def total_steps(self) -> int: ...
    @property
    def episodes(self) -> int: ...
    @property
    def alpha(self) -> float | None: ...
    @property
    def epsilon(self) -> float | None: ...

    @property
    def block_due(self) -> bool:
        """Whether ``end_block`` is to be called now: at step 0, at intervals and at the end."""
        ...

    @property
    def finished(self) -> bool:
        """All steps are done, and the block behind them."""
        ...

    @property
    def best_is_now(self) -> bool:
        """Whether the last block was the best so far, and worth keeping the policy for."""
        ...

    def advance(self) -> None:
        """A little of the way, in bounded time.

        Raises:
            DivergedError: from the learner.
        """
        ...

    def end_block(self) -> dict[str, Value]:
        """Tests the policy; the block's line of metrics."""
        ...


def _never() -> bool:
    return False


def _untold(line: Mapping[str, Value]) -> None: ...


def train(
    config: TrainConfig,
    out_dir: Path,
    resume: bool = False,
    progress: OnProgress = silent,
    clock: Clock = time.perf_counter,
    environment: MakeEnv = make_any_env,
    opened: Callable[[TrainSession], None] = lambda session: None,
    stopped: Callable[[], bool] = _never,
) -> RunSummary:
    """Trains until ``config.total_steps`` on episodes that are played in this process.

    Args:
        out_dir: becomes the run's directory; missing or empty, unless ``resume`` is set.
        resume: where ``out_dir`` holds a run already, continue it from its newest checkpoint,
            bit for bit as if it had never stopped.
        clock: monotonic, seconds.
        environment: makes the environment of a scenario with a number of arenas.
        opened: told the session before its first step.
        stopped: asked between steps whether to save and end early.

    Raises:
        EndedEarly: ``stopped`` said so; there is a checkpoint, unless it was at step 0.
        UserError: the config does not fit the scenario, ``out_dir`` cannot be used, a checkpoint
            is damaged, training diverged, or the result could not be written.
    """
    scenario = (kept_scenario(out_dir) if resume else None) or config.scenario_source()
    env = environment(scenario, config.n_envs)
    test_env = environment(scenario, min(TEST_ARENAS, config.test_episodes))
    session = TrainSession(config, env, test_env)
    with Run(
        *(session, out_dir, resume, progress, clock),
        stopped=stopped,
        scenario=scenario,
        save_stopped=True,
    ) as run:
        opened(session)
        return run.go()


class Run:
    """Steps a session and keeps its files; a context manager.

    Args:
        data: describes the data set of a run on recordings.
        warnings: what the user should know before the first step.
        on_block: told a block's line once it is written, before what follows.
        stopped: asked between steps whether to end early, as the last checkpoint leaves it.
        save_stopped: make that a checkpoint of where it stands.
        scenario: what a new run keeps a copy of.

    Raises:
        UserError: on entering: ``out_dir`` cannot be used, or a checkpoint is damaged.
    """

    def __init__(
        self,
        session: Session,
        out_dir: Path,
        resume: bool,
        progress: OnProgress = silent,
        clock: Clock = time.perf_counter,
        data: dict[str, Any] | None = None,
        warnings: Sequence[str] = (),
        on_block: Callable[[dict[str, Value]], None] = _untold,
        stopped: Callable[[], bool] = _never,
        scenario: ScenarioSource | None = None,
        save_stopped: bool = False,
    ) -> None:
        self._session, self._out_dir, self._resume, self._data = session, out_dir, resume, data
        self._scenario, self._save_stopped = scenario, save_stopped
        self._progress, self._clock = progress, clock
        self._on_block, self._stopped = on_block, stopped
        self._warnings = deque(warnings)
        self._held = ExitStack()
        self._finished = False

    def __enter__(self) -> Self:
        use_one_thread()
        session, out_dir = self._session, self._out_dir
        self._loggers = Chosen(session.config.loggers)
        prepare_run(out_dir, session.config, self._resume, self._data, self._scenario)
        with ExitStack() as held:
            held.enter_context(locked(out_dir))
            extend_run(out_dir, session.config)
            found = list_checkpoints(out_dir / CHECKPOINTS)
            self._checkpoint = found[-1] if found else None
            logged = restore(found[-1], session) if found else Logged()
            self._saved_steps = steps = session.steps
            self._started_s = self._reported_s = self._clock()
            self._marks = deque([(self._started_s, steps)])
            self._log = RunLog(out_dir, logged, self._started_s, steps, session.STEPS)
            held.callback(self._log.close)
            if not session.finished:
                about = read_run(out_dir)
                self._loggers.begin(Start(out_dir, flat(about["config"]), about, steps))
            self._held = held.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._held:
            early = error is None or isinstance(error, EndedEarly | KeyboardInterrupt)
            ended: Status = "stopped" if early else "failed"
            self._warn(self._loggers.finalize("finished" if self._finished else ended))

    def go(self) -> RunSummary:
        """To the end: however the last step came about, a block and a checkpoint lie behind it.

        Raises:
            TrainError: it diverged, or the result could not be written.
            EndedEarly: ``stopped`` said so.
        """
        session = self._session
        while self._warnings:
            self._report("training")
        while True:
            if session.block_due:
                self._block()
            if session.finished:
                break
            if self._stopped():
                if self._save_stopped and session.steps != self._saved_steps:
                    self._save()
                raise EndedEarly
            self._advance()
        self._finished = True
        self._report("finished")
        return self._summary()

    def _advance(self) -> None:
        try:
            self._session.advance()
        except DivergedError as error:
            raise TrainError(keep_batch(self._out_dir, self._session.steps, error)) from error
        if self._clock() - self._reported_s >= REPORT_INTERVAL_S:
            self._report("training")

    def _block(self) -> None:
        session = self._session
        self._report("evaluation")
        line, steps = session.end_block(), session.steps
        try:
            self._log.write(line, self._clock(), steps)
        except OSError as error:
            self._report("training", f"metrics at {steps} steps wait to be written: {error}")
        self._warn(self._loggers.log_metrics(line, steps))
        if session.best_is_now:
            self._save_best()
        due = steps - self._saved_steps
        if due and (due >= session.config.checkpoint_interval_steps or session.finished):
            self._save()
        self._on_block(line)

    def _save_best(self) -> None:
        try:
            save_best(self._out_dir, self._session)
        except OSError as error:
            problem = f"the best checkpoint, at {self._session.steps} steps,"
            self._report("evaluation", f"{problem} was not written: {error}")

    def _save(self) -> None:
        session, steps = self._session, self._session.steps
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

    def _warn(self, problems: Sequence[str]) -> None:
        for problem in problems:
            self._report("training", problem)

    def _report(self, phase: Phase, warning: str | None = None) -> None:
        session, now = self._session, self._clock()
        self._reported_s = now
        if warning is not None:
            self._warnings.append(warning)
        steps, total = session.steps, session.total_steps
        self._marks.append((now, steps))
        while now - self._marks[0][0] > SPEED_WINDOW_S and len(self._marks) > 2:
            self._marks.popleft()
        since_s, since_steps = self._marks[0]
        moving = now > since_s and steps > since_steps
        if not moving and not session.finished and not self._warnings:
            return
        speed = (steps - since_steps) / (now - since_s) if moving else 0.0
        report = ProgressReport(
            phase=phase,
            steps=steps,
            total_steps=total,
            alpha=session.alpha,
            epsilon=session.epsilon,
            success_rate=_number(self._log.last_block.get("success_rate")),
            success_crash_free=_number(self._log.last_block.get("success_crash_free")),
            steps_per_s=speed,
            eta_s=max(0, total - steps) / speed if moving else 0.0,
            warning=self._warnings.popleft() if self._warnings else None,
        )
        self._progress(report)

    def _summary(self) -> RunSummary:
        session = self._session
        if self._checkpoint is None:
            raise RuntimeError("a finished run has no checkpoint")
        return RunSummary(
            out_dir=self._out_dir,
            checkpoint=self._checkpoint,
            steps=session.steps,
            episodes=session.episodes,
            gradient_steps=session.learner.updates,
            wall_s=self._clock() - self._started_s,
            last_block=self._log.last_block,
        )


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
