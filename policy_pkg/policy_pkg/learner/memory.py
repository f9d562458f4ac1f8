"""Memory that is kept between calls: fresh pages cost more than the arithmetic on them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

_LINE_BYTES = 64


def room(nbytes: int) -> npt.NDArray[np.uint8]:
    """At least ``nbytes``, a quarter more for the next call, from a line of the cache on.

    A vector of 64 bytes elsewhere lies in two lines, and a BLAS may sum in another order there.
    """
    raw = np.empty(nbytes + nbytes // 4 + _LINE_BYTES, np.uint8)
    return raw[-raw.ctypes.data % _LINE_BYTES :]
