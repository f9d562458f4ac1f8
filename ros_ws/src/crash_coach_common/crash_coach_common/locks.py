"""Locks between processes: files that the kernel lets go of, however a process ends."""

from __future__ import annotations

import fcntl
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

POLL_S = 0.2


class TakenError(Exception):
    """Another process holds the lock; the text says which, as far as it is known."""


@contextmanager
def held(
    path: Path, wait_s: float = 0.0, waiting: Callable[[], None] = lambda: None, signed: bool = True
) -> Iterator[None]:
    """Holds the lock file ``path``; ends with the process at the latest, even on SIGKILL.

    Args:
        wait_s: how long another process may hold it.
        waiting: called once, before the wait.
        signed: the file is there for this, and says who holds it; otherwise it is some file that
            exists and stays as it is.

    Raises:
        TakenError: it was held for longer.
        OSError: it cannot be opened or written.
    """
    mode = os.O_RDWR | os.O_CREAT if signed else os.O_RDONLY
    descriptor = os.open(path, mode | os.O_CLOEXEC, 0o644)
    try:
        deadline = time.monotonic() + wait_s
        while not _taken(descriptor):
            if time.monotonic() >= deadline:
                raise TakenError(_holder(descriptor) if signed else "unknown")
            waiting()
            waiting = _nothing
            time.sleep(POLL_S)
        if signed:
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)
        yield
    finally:
        os.close(descriptor)


def _holder(descriptor: int) -> str:
    return os.pread(descriptor, 200, 0).decode(errors="replace").strip() or "unknown"


def _nothing() -> None:
    pass


def _taken(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
