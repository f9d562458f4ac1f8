"""A signal whose exception is dropped on its way comes again."""

from __future__ import annotations

import gc
import signal
import time
import weakref
from collections.abc import Callable

import pymunk
import pytest

from crash_coach_bringup.cli.signals import Terminated, raised

LONG_S = 20.0


class Finalised:
    def __init__(self, ended: Callable[[], object]) -> None:
        self._ended = ended

    def __del__(self) -> None:
        self._ended()


def in_a_finaliser(send: Callable[[], None]) -> None:
    Finalised(send)
    gc.collect()


def in_a_weak_references_callback(send: Callable[[], None]) -> None:
    thing = Finalised(bool)
    kept = weakref.ref(thing, lambda _: send())
    del thing
    assert kept() is None


def in_a_callback_of_c_code(send: Callable[[], None]) -> None:
    space = pymunk.Space()
    body = pymunk.Body(1.0, 1.0)
    body.velocity_func = lambda *_: send()
    space.add(body, pymunk.Circle(body, 1.0))
    space.step(0.01)


def interrupted(place: Callable[[Callable[[], None]], None], number: int) -> None:
    with raised():
        place(lambda: signal.raise_signal(number))
        time.sleep(LONG_S)


@pytest.mark.parametrize(
    "place", [in_a_finaliser, in_a_weak_references_callback, in_a_callback_of_c_code]
)
@pytest.mark.parametrize(
    ("number", "kind"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)]
)
def test_a_dropped_signal_comes_again(
    place: Callable[[Callable[[], None]], None], number: int, kind: type[BaseException]
) -> None:
    began_s = time.monotonic()
    with pytest.raises(kind):
        interrupted(place, number)
    assert time.monotonic() - began_s < LONG_S / 2


def test_other_dropped_exceptions_are_told_as_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[type[BaseException]] = []
    monkeypatch.setattr("sys.unraisablehook", lambda dropped: told.append(dropped.exc_type))

    def fails() -> None:
        raise ValueError

    with raised():
        in_a_finaliser(fails)
    assert told == [ValueError]
