"""Modules are loaded without the garbage collector, which is there again afterwards."""

from __future__ import annotations

import gc

import pytest

from crash_coach_common.loading import loading


def test_it_is_off_meanwhile_and_skips_what_was_there() -> None:
    before = gc.get_freeze_count()
    try:
        with pytest.raises(ImportError), loading():
            assert not gc.isenabled()
            kept = [[] for _ in range(1000)]
            raise ImportError
        assert gc.isenabled()
        assert gc.get_freeze_count() >= before + len(kept)
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
