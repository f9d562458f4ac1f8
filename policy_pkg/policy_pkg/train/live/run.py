"""One live training run: its learning thread, its files, and continuing one that was killed."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

import torch

from crash_coach_common.contract import EnvSpec, UserError
from crash_coach_pkg.coach.strategies import make_strategy
from policy_pkg.bags.dataset import RecordedEpisode
from policy_pkg.checkpoint import CHECKPOINTS, list_checkpoints
from policy_pkg.learner.learner import DivergedError
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.live.order import Lockstep, Order, RealTime, Task
from policy_pkg.train.live.session import LiveSession
from policy_pkg.train.metrics import Value
from policy_pkg.train.run import TrainError, keep_batch
from policy_pkg.train.run_dir import locked, prepare_run
from policy_pkg.train.run_log import RunLog
from policy_pkg.train.snapshot import Logged, restore, save
from sim_pkg.env import make_env

Mode = Literal["lockstep", "realtime"]
POLL_S = 0.1  # how soon the thread notices that it is to end
QUEUE_EPISODES = 10_000  # in real time a learner that is too slow falls behind by so many at most


def load_spec(config: TrainConfig) -> EnvSpec:
    """The team's. Raises ConfigError where the scenario is unknown or wrong."""
    return make_env(config.scenario, 1).spec


def reads_blocks(config: TrainConfig) -> bool:
    """Whether the coach's strategy needs the success rates of the run's blocks."""
    return make_strategy(config.coach).needs_success


class LiveRun:
    """Learns in a thread from the episodes that it is given; a context manager.

    Args:
        config: of the run; ``n_envs`` graphs.
        spec: of the team.
        out_dir: becomes the run's directory; missing or empty, unless ``resume`` is set.
        resume: where ``out_dir`` holds a run already, continue it from its newest checkpoint.
        mode: of the graphs' sims; in ``lockstep`` the same seed gives the same run, bit for bit,
            also where it was interrupted at a checkpoint.
        on_tasks: called from the thread with what the graphs are to play.
        on_block: called from the thread with a block's number and metrics, before what follows.
        on_warning: called from the thread with what went wrong and was survived.
        clock: monotonic, seconds.

    Raises:
        UserError: on entering: ``out_dir`` cannot be used, or a checkpoint is damaged.
    """

    def __init__(
        self,
        config: TrainConfig,
        spec: EnvSpec,
        out_dir: Path,
        resume: bool,
        mode: Mode,
        on_tasks: Callable[[list[Task]], None],
        on_block: Callable[[int, dict[str, Value]], None],
        on_warning: Callable[[str], None],
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.session = LiveSession(config, spec)
        self._out_dir, self._resume, self._clock = out_dir, resume, clock
        self._on_tasks, self._on_block, self._on_warning = on_tasks, on_block, on_warning
        order = Lockstep if mode == "lockstep" else RealTime
        self._order: Order = order(self.session, self._end_block)
        self._episodes: queue.Queue[tuple[Task, RecordedEpisode | None]] = queue.Queue(
            QUEUE_EPISODES
        )
        self._stop = threading.Event()
        self._threads = ThreadPoolExecutor(1, thread_name_prefix="learning")
        self._learning: Future[None] | None = None
        self._held = ExitStack()

    def __enter__(self) -> Self:
        session, out_dir = self.session, self._out_dir
        torch.set_num_threads(1)
        prepare_run(out_dir, session.config, self._resume)
        with ExitStack() as held:
            held.enter_context(locked(out_dir))
            held.callback(self._open_log().close)
            self._held = held.pop_all()
        return self

    def _open_log(self) -> RunLog:
        session, out_dir = self.session, self._out_dir
        found = list_checkpoints(out_dir / CHECKPOINTS)
        logged = restore(found[-1], session) if found else Logged()
        self._saved_steps = steps = session.counters.env_steps
        board = session.config.tensorboard and not session.finished
        self._log = RunLog(out_dir, logged, self._clock(), steps, "env_steps", board)
        return self._log

    def start(self) -> None:
        """Begins; from now on ``on_tasks`` is called."""
        self._learning = self._threads.submit(self._run)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop.set()
        self._threads.shutdown()
        self._held.close()

    @property
    def done(self) -> bool:
        """Whether the run is finished.

        Raises:
            UserError: training diverged, or the result could not be written.
        """
        if self._learning is None or not self._learning.done():
            return False
        self._learning.result()
        return True

    @property
    def episodes_waiting(self) -> int:
        """Episodes that the learner has not come to yet."""
        return self._episodes.qsize()

    def played(self, task: Task, recorded: RecordedEpisode | None) -> None:
        """An episode of ``task``; None: it was lost. Returns at once.

        Raises:
            UserError: the learner is hopelessly behind.
        """
        try:
            self._episodes.put_nowait((task, recorded))
        except queue.Full:
            raise UserError(
                f"{QUEUE_EPISODES} episodes wait for the learner: it cannot keep up; take fewer "
                "graphs or fewer updates_per_episode"
            ) from None

    def _run(self) -> None:
        try:
            self._on_tasks(self._order.begin())
            while not self._stop.is_set() and not self.session.finished:
                with suppress(queue.Empty):
                    self._on_tasks(self._order.played(*self._episodes.get(timeout=POLL_S)))
        except DivergedError as error:
            steps = self.session.counters.env_steps
            raise TrainError(keep_batch(self._out_dir, steps, error)) from error

    def _end_block(self, block: Sequence[RecordedEpisode]) -> None:
        session = self.session
        number = session.counters.blocks
        line = session.end_block(block)
        steps = session.counters.env_steps
        try:
            self._log.write(line, self._clock(), steps)
        except OSError as error:
            self._on_warning(f"metrics at {steps} steps wait to be written: {error}")
        due = steps - self._saved_steps
        if due and (due >= session.config.checkpoint_interval_steps or session.finished):
            self._save()
        self._on_block(number, line)

    def _save(self) -> None:
        session, steps = self.session, self.session.counters.env_steps
        try:
            save(self._out_dir, session, self._log.sync())
            self._saved_steps = steps
        except OSError as error:
            problem = f"checkpoint at {steps} steps was not written: {error}"
            if session.finished:
                raise TrainError(f"{problem}; make room and resume {self._out_dir}") from error
            self._on_warning(f"{problem}; the next block tries again")
