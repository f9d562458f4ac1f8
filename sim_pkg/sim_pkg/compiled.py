"""How compiled functions are compiled: ``entry`` for what Python calls, ``helper`` for the rest."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from crash_coach_common.quick_numba import njit

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
