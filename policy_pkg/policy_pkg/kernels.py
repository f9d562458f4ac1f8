"""Which compiled kernels do the arithmetic, and that they are the same on every machine.

OpenBLAS picks its kernels by the processor, and kernels differ in the order in which they sum. A
seed trains the same team on every x86-64 machine only where all use the same ones: those of the
Haswell family, which every machine with AVX2 runs.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

CORETYPE = "OPENBLAS_CORETYPE"
SAME_EVERYWHERE = "Haswell"


def pin_kernels() -> None:
    """Has OpenBLAS use Haswell's kernels; call before numpy is loaded.

    Does nothing where the variable is set already, and on a processor without AVX2.
    """
    if CORETYPE not in os.environ and "numpy" not in sys.modules and _has_avx2():
        os.environ[CORETYPE] = SAME_EVERYWHERE


def _has_avx2() -> bool:
    try:
        return " avx2 " in Path("/proc/cpuinfo").read_text()
    except OSError:
        return False


def kernels() -> dict[str, str | None]:
    """What numpy computes with in this process: ``openblas``, None where it has another BLAS."""
    import numpy  # noqa: F401 - so that its BLAS is loaded
    from threadpoolctl import threadpool_info

    found = [info for info in threadpool_info() if info.get("internal_api") == "openblas"]
    return {"openblas": str(found[0]["architecture"]) if found else None}
