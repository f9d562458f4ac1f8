"""Modules are loaded without the garbage collector, which is there again afterwards."""

from __future__ import annotations

import gc
import importlib

import pytest

from crash_coach_common.loading import loading

KEPT: list[list[int]] = []


def fail() -> None:
    with loading():
        assert not gc.isenabled()
        KEPT.extend([] for _ in range(1000))
        importlib.import_module("no_such_module_anywhere")


def test_it_is_off_meanwhile_and_skips_what_was_there() -> None:
    before = gc.get_freeze_count()
    try:
        with pytest.raises(ModuleNotFoundError):
            fail()
        assert gc.isenabled()
        assert gc.get_freeze_count() >= before + len(KEPT)
    finally:
        gc.unfreeze()


def test_it_stays_off_where_it_was_off() -> None:
    gc.disable()
    try:
        with loading():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()
        gc.unfreeze()
