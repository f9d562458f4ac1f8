"""Starts executables: ready for signals before anything else is loaded."""

from __future__ import annotations

import importlib
import os
import signal
import sys
from types import FrameType
from typing import NoReturn

from crash_coach_common.loading import loading


def command(module: str) -> tuple[str, ...]:
    """What starts ``module`` so, for one without a script of its own."""
    return (sys.executable, "-m", "crash_coach_common.executable", module)


def run(module: str) -> int:
    """Loads ``module``, which takes its second or two, and calls its ``main``.

    Meanwhile SIGINT and SIGTERM end the process at once, with exit code 0 and without a word, as
    they do later: nothing is begun yet that had to be ended in order.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup
            signal.signal(number, _leave)
    with loading():
        loaded = importlib.import_module(module)
    result: int = loaded.main()
    return result


def _leave(number: int, frame: FrameType | None) -> NoReturn:
    os._exit(0)


if __name__ == "__main__":
    sys.exit(run(sys.argv.pop(1)))
