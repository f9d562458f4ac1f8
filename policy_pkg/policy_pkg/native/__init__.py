"""The compiled kernels, of robots that act and of the learner: which of set-up's builds is used.

Two builds of the same sources, for AVX-512 and for AVX2, give the same bits; the machine's best is
taken.
``CRASH_COACH_KERNEL`` (avx512, avx2, torch) asks for one.
"""

from __future__ import annotations

import ctypes
import os
import sys
from functools import cache
from pathlib import Path
from typing import Any

from crash_coach_common.contract import UserError

FOLDER = Path(sys.prefix) / "lib" / "crash_coach"
VARIABLE = "CRASH_COACH_KERNEL"
TORCH = "torch"
_INT, _POINTER = ctypes.c_int, ctypes.c_void_p
_UNROLL: list[Any] = [_INT, _POINTER, *[_INT] * 4]
_QMIX: list[Any] = [_INT] * 5
_STEP: list[Any] = [_POINTER, _INT, _POINTER]
# by function: what it takes, and what it returns
_FUNCTIONS: dict[str, tuple[list[Any], Any]] = {
    "unroll_forward": (_UNROLL + [_POINTER] * 4, None),
    "unroll_backward": (_UNROLL + [_POINTER] * 5, None),
    "unroll_tape": ([_INT] * 2, ctypes.c_size_t),
    "qmix_forward": (_QMIX + [_POINTER] * 5, None),
    "qmix_backward": (_QMIX + [_POINTER] * 7, None),
    "qmix_tape": ([_INT] * 5, ctypes.c_size_t),
    "acting_new": ([_INT] * 4 + [_POINTER], _POINTER),
    "acting_set": ([_POINTER] * 2, None),
    "acting_free": ([_POINTER], None),
    "acting_widths": ([_POINTER] * 3, None),
    "acting_gates": (_STEP, _INT),
    "acting_candidate": (_STEP, None),
    "acting_values": (_STEP, None),
}
FLAGS = {"avx512": {"avx512f", "fma"}, "avx2": {"avx2", "fma"}}  # best first


def build_name() -> str | None:
    """Which build this process uses: avx512 or avx2; None: none, numpy acts and torch learns.

    Raises:
        UserError: CRASH_COACH_KERNEL asks for what is not there.
    """
    return _build(os.environ.get(VARIABLE, ""), FOLDER)


@cache
def _build(asked: str, folder: Path) -> str | None:
    if asked == TORCH:
        return None
    flags = _flags()
    able = [
        name for name, needed in FLAGS.items() if needed <= flags and path(name, folder).is_file()
    ]
    if not asked:
        return able[0] if able else None
    if asked not in able:
        raise UserError(
            f"{VARIABLE}={asked}: this machine has {', '.join([*able, TORCH])}; "
            "'make setup' builds what its processor can run"
        )
    return asked


def library() -> ctypes.CDLL | None:
    """The kernels of ``build_name``; None: there are none. Raises as it does."""
    name = build_name()
    return None if name is None else _loaded(name, FOLDER)


@cache
def _loaded(name: str, folder: Path) -> ctypes.CDLL:
    found = ctypes.CDLL(str(path(name, folder)))
    for function, (takes, returns) in _FUNCTIONS.items():
        getattr(found, function).argtypes = takes
        getattr(found, function).restype = returns
    return found


def path(name: str, folder: Path) -> Path:
    """Of a build."""
    return folder / f"kernels_{name}.so"


@cache
def _flags() -> frozenset[str]:
    """Of the processor; none where Linux does not tell."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return frozenset()
    return frozenset(next((line.split() for line in lines if line.startswith("flags")), []))
