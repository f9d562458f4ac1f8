"""Goodness of fit for the statistical tests of this folder."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

Fits = Callable[[npt.ArrayLike, npt.ArrayLike], bool]


def _fits(observed: npt.ArrayLike, expected: npt.ArrayLike) -> bool:
    """Pearson's chi-square test at about 0.1 % (Wilson and Hilferty's normal approximation)."""
    o, e = np.broadcast_arrays(np.asarray(observed, float), np.asarray(expected, float))
    assert abs(o.sum() - e.sum()) < 1e-6 * e.sum()
    df = o.size - 1
    statistic = float(((o - e) ** 2 / e).sum())
    spread = 2 / (9 * df)
    z = ((statistic / df) ** (1 / 3) - (1 - spread)) / math.sqrt(spread)
    return float(z) < 3.09


@pytest.fixture
def fits() -> Fits:
    return _fits
