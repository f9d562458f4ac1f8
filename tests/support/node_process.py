"""Processes of our executables, forked from one that has loaded what they load.

A third of the suite's time went to loading the same modules in hundreds of processes. What is
installed and how it starts, test_executables.py and test_early_signals.py in tests/ros/bringup see.
"""

from __future__ import annotations

import gc
import importlib
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import IO, NoReturn

from crash_coach_bringup.ros.probe import find_executable

START_S = 60.0
_LOADING = ("LD_LIBRARY_PATH", "LD_PRELOAD", "PYTHONPATH")
NODES = (
    "crash_coach_pkg.ros.coach_node",
    "crash_coach_pkg.ros.gate_node",
    "policy_pkg.ros.policy_node",
    "policy_pkg.ros.team_node",
    "sim_pkg.ros.sim_node",
)


class NodeProcess:
    """A running executable: as much of subprocess.Popen, with pipes of text, as tests use.

    ``merged``: what it writes to stderr comes with stdout.
    """

    def __init__(
        self, name: str, package: str, arguments: Sequence[str], env: dict[str, str], merged: bool
    ) -> None:
        argv = [str(find_executable(package, name)), *arguments]
        pipes = [_server().Pipe(duplex=False) for _ in range(3)]
        (session, *read), (begun, out, err) = zip(*pipes, strict=True)
        self._process = _server().Process(
            target=_run, args=(argv, package, env, begun, out, out if merged else err), daemon=True
        )
        self._process.start()
        for end in (begun, out, err):
            end.close()
        assert session.poll(START_S), "it has no session of its own"
        session.close()
        assert self._process.pid is not None
        self.pid = self._process.pid
        self.stdout, self.stderr = (os.fdopen(os.dup(end.fileno())) for end in read)
        for end in read:
            end.close()
        self._reading: list[Future[str]] = []

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def poll(self) -> int | None:
        return self._process.exitcode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def wait(self, timeout: float) -> int:
        """Raises subprocess.TimeoutExpired."""
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired(str(self.pid), timeout)
        return self._process.exitcode

    def communicate(self, timeout: float) -> tuple[str, str]:
        """What it wrote until its end. Raises TimeoutExpired or, for a pipe, TimeoutError."""
        if not self._reading:
            pool = ThreadPoolExecutor(2)
            self._reading = [pool.submit(_read, file) for file in (self.stdout, self.stderr)]
            pool.shutdown(wait=False)
        self.wait(timeout)
        out, err = (each.result(timeout) for each in self._reading)
        return out, err


Child = NodeProcess | subprocess.Popen[str]


def start(
    name: str, package: str, arguments: Sequence[str], env: dict[str, str], merged: bool = False
) -> Child:
    """In a session of its own, with no other environment than ``env``."""
    if any(env.get(variable) != os.environ.get(variable) for variable in _LOADING):
        # It loads other modules than the server has.
        return start_file([str(find_executable(package, name)), *arguments], env, merged)
    return NodeProcess(name, package, arguments, env, merged)


def start_file(
    argv: Sequence[str], env: dict[str, str], merged: bool = False
) -> subprocess.Popen[str]:
    """As ``start``, but the file that is installed: where it matters what it loads."""
    return subprocess.Popen(
        argv,
        env=env,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT if merged else subprocess.PIPE,
        start_new_session=True,
    )


@cache
def _server() -> ForkServerContext:
    """One for each of pytest's workers; it ends with it."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__, *NODES])
    return context


def _read(file: IO[str]) -> str:
    with file:
        return file.read()


def _run(
    argv: list[str],
    package: str,
    env: dict[str, str],
    begun: Connection,
    out: Connection,
    err: Connection,
) -> NoReturn:
    """In the new process: as the script that is installed as ``argv[0]``."""
    gc.freeze()  # it shares its modules' pages with all others as long as nobody looks through them
    os.setsid()
    begun.close()
    os.dup2(out.fileno(), 1)
    os.dup2(err.fileno(), 2)
    out.close()
    if err is not out:
        err.close()
    os.environ.clear()
    os.environ.update(env)
    sys.argv = argv
    main = getattr(importlib.import_module(f"{package}.executables"), Path(argv[0]).name)
    sys.exit(main())
