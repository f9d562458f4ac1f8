"""The compiled kernels, of robots that act and of the learner: which of set-up's builds is used.

Two builds of the same sources, for AVX-512 and for AVX2, give the same bits; the machine's best is
taken.
``CRASH_COACH_KERNEL`` (avx512, avx2, torch) asks for one.
"""

from __future__ import annotations

import os
import sys
from functools import cache
from pathlib import Path

from crash_coach_common.contract import UserError

FOLDER = Path(sys.prefix) / "lib" / "crash_coach"
VARIABLE = "CRASH_COACH_KERNEL"
TORCH = "torch"
FLAGS = {"avx512": {"avx512f", "fma"}, "avx2": {"avx2", "fma"}}  # best first


def build_name() -> str | None:
    """Which build this process uses: avx512 or avx2; None: none, torch does it.

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
