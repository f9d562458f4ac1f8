"""How compiled functions are compiled: ``entry`` for what Python calls, ``helper`` for the rest."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
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

helper: Callable[[Callable[..., Any]], Any] = njit(cache=True, forceinline=True, _nrt=False)
"""For functions that only compiled ones call, and that allocate nothing.

They become part of their caller and do not count references to the arrays they are given, as
numba's functions else do: two atomic operations per array and call, which in a skirmish took
longer than the fight. ``_nrt``, numba's runtime, is no documented option; a numba without it would
refuse it.
"""


def entry(function: Callable[..., Any]) -> Any:
    """Compiles, and keeps the code until any file of the function's package or of this one changes.

    Numba itself looks at the function's own file only, and would keep what it has compiled of a
    helper or of a constant in another one. It names what it keeps by the qualified name.
    """
    for file in (inspect.getfile(function), __file__):
        function.__qualname__ += f"_{_digest(_package(Path(file).parent))}"
    return njit(cache=True)(function)


@cache
def _package(folder: Path) -> Path:
    """The outermost package that the folder lies in."""
    while (folder / "__init__.py").is_file() and (folder.parent / "__init__.py").is_file():
        folder = folder.parent
    return folder


@cache
def _digest(package: Path) -> str:
    sources = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        sources.update(path.read_bytes())
    return sources.hexdigest()[:8]
