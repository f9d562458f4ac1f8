"""numba's ``njit``, loaded without what nothing here compiles with: a third of its time.

For packages that depend on numba; this one does not, and nothing of it imports this module.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from typing import Any


def _njit() -> Any:
    """numba's, which looks for ``coverage`` when it is loaded and else loads that for nothing: a
    sixth of its own time. Where coverage measures, it is loaded already."""
    spared = "coverage" not in sys.modules
    if spared:
        sys.modules["coverage"] = None  # type: ignore[assignment]
    try:
        return importlib.import_module("numba").njit
    finally:
        if spared:
            del sys.modules["coverage"]


njit = _njit()


def _spare_scipy() -> None:
    """Where SciPy is there, numba is spared loading its linear algebra to find that out.

    That took 0.2 s of every process's start, and nothing here is compiled with it. What somebody
    else compiles with it loads it then, as numba does in any case.
    """
    if importlib.util.find_spec("scipy") is None:
        return
    linalg: Any = importlib.import_module("numba.np.linalg")
    ensure, linalg.ensure_blas = linalg.ensure_blas, lambda: None
    try:
        importlib.import_module("numba.np.arraymath")  # looks while it is loaded
    finally:
        linalg.ensure_blas = ensure


_spare_scipy()
