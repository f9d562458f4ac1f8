"""A sweep at work: which runs are left, who does them, what becomes of them. Knows no engine."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

from policy_pkg.sweep.config import SweepRun
from policy_pkg.sweep.folder import (
    HIDDEN,
    RunFiles,
    RunProgress,
    Standing,
    exclusive,
    read_progress,
    standing,
)
from policy_pkg.sweep.task import Task

POLL_S = 0.2
LOOK_S = 1.0  # between two looks at every run's progress
LOCK_WAIT_S = 120.0


@dataclass(frozen=True)
class Ended:
    """A run whose process ended; ``error``: why it is not finished."""

    name: str
    error: str | None


class Engine(Protocol):
    """Does runs. ``slots``: how many it takes at a time."""

    slots: int

    def start(self, task: Task) -> None:
        """Takes a run; returns at once. Raises OSError where it cannot be begun."""
        ...

    def poll(self) -> list[Ended]:
        """The runs that ended since the last call."""
        ...

    def stop(self) -> None:
        """Ends all runs in bounded time."""
        ...


@dataclass(frozen=True)
class Event:
    """Something that happened to a run; ``text``: of a failure or a warning."""

    kind: Literal["started", "finished", "failed", "warning"]
    name: str
    text: str = ""


@dataclass(frozen=True)
class Snapshot:
    """Where a sweep stands. ``running``: None for a run that has said nothing yet.

    eta_s: at the present speed; None where nothing moves.
    """

    runs: int
    done: int
    failed: int
    waiting: int
    running: dict[str, RunProgress | None]
    steps_left: int
    steps_per_s: float

    @property
    def eta_s(self) -> float | None:
        return self.steps_left / self.steps_per_s if self.steps_per_s > 0 else None


@dataclass
class Sweep:
    """Runs in ``out``, of which those that are done are not done again.

    Args:
        out: absolute.
        have: folders in which finished runs count too.
        command: kept in every run as the way to repeat it.

    Raises:
        RunError: a folder holds a run of another configuration.
    """

    runs: Sequence[SweepRun]
    out: Path
    have: Sequence[Path] = ()
    command: Sequence[str] = field(default_factory=lambda: list(sys.argv))
    lock_wait_s: float = LOCK_WAIT_S
    standings: dict[str, Standing] = field(init=False)
    failed: dict[str, str] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self.standings = {run.name: standing(run, self.out, self.have) for run in self.runs}
        self._waiting = [run for run in self.runs if not self.standings[run.name].done]
        self._running: dict[str, SweepRun] = {}
        self._warned: dict[str, str] = {}

    @property
    def left(self) -> int:
        """Runs that are neither done nor failed."""
        return len(self._waiting) + len(self._running)

    def work(
        self,
        engine: Engine,
        tell: Callable[[Event], None] = lambda event: None,
        watch: Callable[[Snapshot], None] = lambda snapshot: None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """Until every run is done or failed, or ``stopped`` says so.

        Raises:
            OSError: the folder cannot be written.
            RunError: another sweep works here.
        """
        with exclusive(self.out / HIDDEN / "lock", 0.0, f"{self.out} is being worked on"):
            try:
                look_s = -LOOK_S
                while self.left and not stopped():
                    self._fill(engine, tell)
                    if time.monotonic() - look_s >= LOOK_S:
                        look_s = time.monotonic()
                        watch(self._look(tell))
                    self._take(engine.poll(), tell)
                    time.sleep(POLL_S)
            finally:
                engine.stop()

    def _fill(self, engine: Engine, tell: Callable[[Event], None]) -> None:
        while self._waiting and len(self._running) < engine.slots:
            run = self._waiting.pop(0)
            try:
                RunFiles(self.out, run.name).prepare()
                engine.start(self._task(run))
            except OSError as error:
                self._fail(run.name, f"it could not be started: {error}", tell)
                continue
            self._running[run.name] = run
            tell(Event("started", run.name))

    def _fail(self, name: str, why: str, tell: Callable[[Event], None]) -> None:
        self.failed[name] = why
        tell(Event("failed", name, why))

    def _task(self, run: SweepRun) -> Task:
        return Task(
            name=run.name,
            config=run.config,
            out=str(self.out),
            cwd=str(Path.cwd()),
            command=list(self.command),
            lock_wait_s=self.lock_wait_s,
        )

    def _take(self, ended: Sequence[Ended], tell: Callable[[Event], None]) -> None:
        for name, error in ((each.name, each.error) for each in ended):
            run = self._running.pop(name)
            # What lies on the disk decides.
            now = self.standings[name] = standing(run, self.out)
            if now.done:
                tell(Event("finished", name))
                continue
            self._fail(name, error or f"it ended at {now.steps:,} steps without a word", tell)

    def _look(self, tell: Callable[[Event], None]) -> Snapshot:
        running = {name: read_progress(RunFiles(self.out, name).progress) for name in self._running}
        for name, progress in running.items():
            warning = progress.warning if progress else None
            if warning and self._warned.get(name) != warning:
                self._warned[name] = warning
                tell(Event("warning", name, warning))
        left = sum(run.config.total_steps - self.standings[run.name].steps for run in self._waiting)
        for name, progress in running.items():
            done = progress.env_steps if progress else self.standings[name].steps
            left += max(0, self._running[name].config.total_steps - done)
        return Snapshot(
            runs=len(self.runs),
            done=sum(each.done for each in self.standings.values()),
            failed=len(self.failed),
            waiting=len(self._waiting),
            running=running,
            steps_left=left,
            steps_per_s=sum(each.steps_per_s for each in running.values() if each),
        )
