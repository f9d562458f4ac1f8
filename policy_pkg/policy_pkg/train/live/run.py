"""One live training run: its learning thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

from crash_coach_common.contract import EnvSpec
from crash_coach_pkg.coach.strategies import find_strategy
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.live.order import Lockstep, Order, RealTime, Task
from policy_pkg.train.live.session import LiveSession
from policy_pkg.train.metrics import Value
from policy_pkg.train.progress import ProgressReport
from policy_pkg.train.run import EndedEarly, Run
from sim_pkg.env import make_env

Mode = Literal["lockstep", "realtime"]
ORDERS: dict[Mode, type[Order]] = {"lockstep": Lockstep, "realtime": RealTime}


def load_spec(config: TrainConfig) -> EnvSpec:
    """The team's. Raises ConfigError where the scenario is unknown or wrong."""
    return make_env(config.scenario_source(), 1).spec


def reads_blocks(config: TrainConfig) -> bool:
    """Whether the coach's strategy reads the success rates of the run's blocks."""
    return find_strategy(config.coach.strategy).reads_blocks


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
        self.session = LiveSession(config, spec, ORDERS[mode], on_tasks)
        self._on_block, self._on_warning = on_block, on_warning
        self._stop = threading.Event()
        self._run = Run(
            *(self.session, out_dir, resume, self._tell, clock),
            on_block=self._block_written,
            stopped=self._stop.is_set,
            scenario=config.scenario_source(),
        )
        self._threads = ThreadPoolExecutor(1, thread_name_prefix="learning")
        self._learning: Future[None] | None = None

    def __enter__(self) -> Self:
        self._run.__enter__()
        return self

    def start(self) -> None:
        """Begins; from now on ``on_tasks`` is called."""
        self._learning = self._threads.submit(self._learn)

    def _learn(self) -> None:
        with suppress(EndedEarly):
            self._run.go()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop.set()
        self._threads.shutdown()
        self._run.__exit__(kind, error, trace)

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

    def _tell(self, report: ProgressReport) -> None:
        if report.warning is not None:
            self._on_warning(report.warning)

    def _block_written(self, line: dict[str, Value]) -> None:
        self._on_block(self.session.counters.blocks - 1, line)
