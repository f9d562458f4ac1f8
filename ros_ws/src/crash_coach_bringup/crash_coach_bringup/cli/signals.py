"""SIGINT and SIGTERM as one line and an exit code, from the first moment to the last."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

_AGAIN_S = 0.02
WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


class Terminated(SystemExit):
    """SIGTERM, as an exception, so that what was begun is ended in order."""

    def __init__(self) -> None:
        super().__init__(exit_code(signal.SIGTERM))


_RAISED: dict[int, type[BaseException]] = {
    signal.SIGINT: KeyboardInterrupt,
    signal.SIGTERM: Terminated,
}


def exit_code(number: int) -> int:
    """As a shell tells it."""
    return 128 + number


def line(number: int) -> str:
    return f"crash-coach: {WORDS[signal.Signals(number)]}"


def leave_at_once() -> None:
    """For the time in which libraries are loaded: nothing is begun that had to be ended in order,
    and an exception could come out anywhere in them, or be swallowed."""
    for number in WORDS:
        _set(number, _leave)


def _leave(number: int, frame: FrameType | None) -> NoReturn:
    os.write(2, f"{line(number)}\n".encode())
    os._exit(exit_code(number))


@contextmanager
def raised() -> Iterator[None]:
    """In the body SIGINT is KeyboardInterrupt and SIGTERM Terminated; in the main thread only.

    Also where Python drops exceptions: in a callback of C code (pymunk's are cffi's), a finaliser,
    a weak reference's callback. From there it comes again.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in WORDS}
    hook = sys.unraisablehook
    heard = threading.Event()

    def handle(number: int, frame: FrameType | None) -> NoReturn:
        heard.set()
        raise _RAISED[number]

    def dropped(what: sys.UnraisableHookArgs) -> None:
        number = next((n for n, kind in _RAISED.items() if kind is what.exc_type), None)
        if number is None:
            hook(what)
            return
        heard.clear()
        threading.Thread(target=_until, args=(heard, number), daemon=True).start()

    for number in _RAISED:
        _set(number, handle)
    sys.unraisablehook = dropped
    try:
        yield
    finally:
        heard.set()
        sys.unraisablehook = hook
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def noted() -> Iterator[Callable[[], bool]]:
    """In the body SIGINT is a flag, for what saves before it ends; in the main thread only."""
    received = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield received.is_set
        return
    before = signal.getsignal(signal.SIGINT)
    _set(signal.SIGINT, lambda number, frame: received.set())
    try:
        yield received.is_set
    finally:
        signal.signal(signal.SIGINT, before)


def _until(heard: threading.Event, number: int) -> None:
    """Send a signal to the main thread until it is heard: one that comes just before a wait begins
    does not end that wait."""
    main = threading.main_thread().ident
    assert main is not None
    while not heard.wait(_AGAIN_S):
        signal.pthread_kill(main, number)


def _set(number: int, handler: signal._HANDLER) -> None:
    """Unless the signal is ignored, as under nohup."""
    if signal.getsignal(number) is not signal.SIG_IGN:
        signal.signal(number, handler)
