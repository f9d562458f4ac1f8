"""Spawned processes that hear Ctrl-C once they can: a terminal sends it to all of a group."""

from __future__ import annotations

import signal
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess


def start_deaf(process: BaseProcess) -> None:
    """Starts ``process``, in which SIGINT waits until it calls ``hear``.

    While it still loads what its target is made of, Python would end it with a traceback.
    """
    resource_tracker.ensure_running()  # the first process would start it, and that unblocks SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def hear() -> None:
    """In the process, when it has its handler: a SIGINT that waits comes now."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
