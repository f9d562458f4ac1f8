"""Which compiled kernels do the arithmetic, and that they are the same on every machine.

OpenBLAS and torch pick their kernels by the processor, and kernels differ in the order in which
they sum. A seed trains the same team on every x86-64 machine only where all use the same ones:
OpenBLAS' for the Haswell family and torch's for AVX2, which every machine with AVX2 runs.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

# by the library that reads it: the variable, and what every machine with AVX2 runs
SAME_EVERYWHERE = {
    "numpy": ("OPENBLAS_CORETYPE", "Haswell"),
    "torch": ("ATEN_CPU_CAPABILITY", "avx2"),
}


def pin_kernels() -> None:
    """Has OpenBLAS and torch use kernels for AVX2; call before numpy and torch are loaded.

    Leaves alone what is set already, and everything on a processor without AVX2.
    """
    for library, (variable, kernels) in SAME_EVERYWHERE.items():
        if variable not in os.environ and library not in sys.modules and _has_avx2():
            os.environ[variable] = kernels


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
