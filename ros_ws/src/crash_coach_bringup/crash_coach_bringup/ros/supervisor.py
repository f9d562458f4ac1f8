"""Starts the processes of a graph, watches them, and leaves none behind."""

from __future__ import annotations

import ctypes
import os
import selectors
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

from crash_coach_bringup.ros.graph import Process

TAIL_LINES = 15
STOPS = ((signal.SIGINT, 3.0), (signal.SIGTERM, 2.0), (signal.SIGKILL, 5.0))
"""What a process is asked with, and how long it may take, in seconds."""

_PR_SET_PDEATHSIG = 1  # prctl(2)
_LIBC = ctypes.CDLL(None, use_errno=True)  # loaded here: nothing may be loaded after a fork


@dataclass(frozen=True)
class Ended:
    """A process that ended by itself. exit_code: negative for the signal that killed it."""

    name: str
    exit_code: int
    log: Path
    tail: str  # the last lines of its log

    def describe(self) -> str:
        code = self.exit_code
        how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        said = f"; it said:\n{self.tail}" if self.tail else f"; {self._silent()}"
        return f"{self.name} died ({how}, log {self.log}){said}"

    def _silent(self) -> str:
        """Why there are no last words."""
        folder = self.log.parent
        if folder.is_dir() and shutil.disk_usage(folder).free == 0:
            return f"No space left on device for what it said: {folder}"
        return "it said nothing"


@dataclass(frozen=True)
class Event:
    """What happened, for whoever shows it to the user."""

    kind: Literal[
        "started", "ready", "robot", "episode", "died", "finished", "interrupted", "summary",
        "stopped",
    ]  # fmt: skip
    process: str
    text: str


class Supervisor:
    """Runs processes as a context manager; leaving it stops them all, within STOPS' bounds.

    Each process is a group of its own, so that a Ctrl-C in the terminal reaches only this
    process, which then stops the rest in order. The kernel kills every one of them should
    this process (to be exact: the thread that started them) vanish, even by SIGKILL.

    With ``throughput`` the processes run under SCHED_BATCH: one that is woken by a message waits
    until the running one pauses, instead of interrupting it at each. That suits lock-step, where
    nobody waits for the clock (measured: 1.3 to 1.5 times the steps per second on two cores).

    Raises on entering:
        OSError: a process cannot be started, or a log not be written.
    """

    def __init__(
        self,
        processes: Sequence[Process],
        log_dir: Path,
        environment: Mapping[str, str],
        throughput: bool = False,
    ) -> None:
        self._throughput = throughput
        self._processes = tuple(processes)
        self._log_dir = log_dir
        self._environment = {**os.environ, **environment, "PYTHONUNBUFFERED": "1"}
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._selector = selectors.DefaultSelector()

    def __enter__(self) -> Self:
        self._log_dir.mkdir(parents=True, exist_ok=True)
        try:
            for process in self._processes:
                self._start(process)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def log_of(self, name: str) -> Path:
        return self._log_dir / f"{name}.log"

    def pids(self) -> dict[str, int]:
        """Process ids of what still runs."""
        return {name: child.pid for name, child in self._running.items()}

    def _start(self, process: Process) -> None:
        parent = os.getpid()

        def die_with_parent() -> None:
            _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
            if self._throughput:
                os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
            if os.getppid() != parent:  # it vanished between fork and prctl
                os._exit(1)

        with open(self.log_of(process.name), "wb") as log:
            child = subprocess.Popen(
                process.argv,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=self._environment,
                process_group=0,
                preexec_fn=die_with_parent,
            )
        self._running[process.name] = child
        self._selector.register(os.pidfd_open(child.pid), selectors.EVENT_READ, process.name)

    def wait(self, timeout_s: float) -> list[Ended]:
        """Waits until a process ends, at most ``timeout_s``; returns those that did."""
        if not self._running:
            return []
        return [self._reap(key) for key, _ in self._selector.select(timeout_s)]

    def _reap(self, key: selectors.SelectorKey) -> Ended:
        name: str = key.data
        self._selector.unregister(key.fd)
        os.close(key.fd)
        exit_code = self._running.pop(name).wait()
        log = self.log_of(name)
        lines = log.read_text(errors="replace").strip().splitlines()
        return Ended(name, exit_code, log, "\n".join(lines[-TAIL_LINES:]))

    def stop(self) -> None:
        """Ends what still runs: SIGINT, then SIGTERM, then SIGKILL."""
        for number, patience_s in STOPS:
            for child in self._running.values():
                # Not reaped yet, so the id is still this child's, and its group exists.
                os.killpg(child.pid, number)
            deadline = time.monotonic() + patience_s
            while self._running and (left_s := deadline - time.monotonic()) > 0:
                self.wait(left_s)
        self._selector.close()
        if self._running:
            raise RuntimeError(f"processes that SIGKILL did not end: {self.pids()}")


def watch(
    supervisor: Supervisor,
    last: Sequence[str],
    interrupted: Callable[[], bool],
    on_event: Callable[[Event], None],
    poll_s: float = 0.1,
    meanwhile: Callable[[], None] = lambda: None,
    companions: Collection[str] = (),
) -> int:
    """Waits for the end of the graph; the exit code for the command line.

    ``meanwhile`` is called every ``poll_s``. That one of the ``companions`` dies is told, no more.

    The normal end is that a process named in ``last`` (the sim, after its episodes) exits 0: 0.
    An interruption by the user is 130, as in a shell. Any other end is a death: 1.
    """
    while not interrupted():
        meanwhile()
        ended = supervisor.wait(poll_s)
        for e in [e for e in ended if e.name in companions]:
            on_event(Event("died", e.name, e.describe()))
            ended.remove(e)
        for e in ended:
            if e.name in last and e.exit_code == 0:
                on_event(Event("finished", e.name, "all episodes are done"))
                return 0
        for e in ended:
            on_event(Event("died", e.name, e.describe()))
        if ended:
            return 1
    on_event(Event("interrupted", "", "stopping every process"))
    return 130
