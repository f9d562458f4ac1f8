"""The compiled unroll of the agent net: loads what set-up built of ``unroll.cpp``, if it did.

Two builds of one source, for AVX-512 and for AVX2, give the same bits; the machine's best is taken.
``CRASH_COACH_KERNEL`` (avx512, avx2, numpy) asks for one.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import UserError

Array = npt.NDArray[Any]
FOLDER = Path(sys.prefix) / "lib" / "crash_coach"
VARIABLE = "CRASH_COACH_KERNEL"
NUMPY = "numpy"
FLAGS = {"avx512": {"avx512f", "fma"}, "avx2": {"avx2", "fma"}}  # best first
NAMES = (
    *("fc1.weight", "fc1.bias", "rnn.weight_ih", "rnn.weight_hh", "rnn.bias_ih", "rnn.bias_hh"),
    *("fc2.weight", "fc2.bias"),
)
_FLOATS = np.ctypeslib.ndpointer(np.float32, flags="C_CONTIGUOUS")
_INTS = np.ctypeslib.ndpointer(np.int32, flags="C_CONTIGUOUS")
_POINTERS = ctypes.POINTER(ctypes.c_void_p)
_INT = ctypes.c_int


@dataclass(frozen=True)
class Tape:
    """What a forward pass leaves for the backward one."""

    inputs: Array  # (R, I)
    sizes: Array  # (T,) int32 rows at each time
    floats: Array  # the kernel's own


def build_name() -> str | None:
    """Which build this process uses: avx512 or avx2; None: none, numpy does it.

    Raises:
        UserError: CRASH_COACH_KERNEL asks for what is not there.
    """
    asked = os.environ.get(VARIABLE, "")
    if asked == NUMPY:
        return None
    flags = _flags()
    able = [name for name, needed in FLAGS.items() if needed <= flags and _path(name).is_file()]
    if not asked:
        return able[0] if able else None
    if asked not in able:
        raise UserError(
            f"{VARIABLE}={asked}: this machine has {', '.join([*able, NUMPY])}; "
            "'make setup' builds what its processor can run"
        )
    return asked


def _path(name: str) -> Path:
    return FOLDER / f"unroll_{name}.so"


@cache
def _flags() -> frozenset[str]:
    """Of the processor; none where Linux does not tell."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return frozenset()
    return frozenset(next((line.split() for line in lines if line.startswith("flags")), []))


class Unroll:
    """Forward and backward over a packed batch of float32."""

    def __init__(self, name: str) -> None:
        library = ctypes.CDLL(str(_path(name)))
        self._tape, self._forward, self._backward = (
            library.unroll_tape,
            library.unroll_forward,
            library.unroll_backward,
        )
        sizes: list[Any] = [_INT, _INTS, _INT, _INT, _INT, _INT]
        self._tape.argtypes, self._tape.restype = [_INT, _INT], ctypes.c_size_t
        self._forward.argtypes = [*sizes, _FLOATS, _POINTERS, _FLOATS, _FLOATS]
        self._backward.argtypes = [*sizes, _FLOATS, _POINTERS, _FLOATS, _FLOATS, _POINTERS]
        self._forward.restype = self._backward.restype = None
        self._kept: dict[bool, Array] = {}

    def forward(
        self, params: Mapping[str, Array], inputs: Array, sizes: Sequence[int], keep: bool
    ) -> tuple[Array, Tape]:
        """Action values (R, A) of the packed rows ``inputs`` (R, I), and the tape.

        The tape is valid until the next call with the same ``keep``.
        """
        inputs = np.ascontiguousarray(inputs)
        rows, counts = len(inputs), np.asarray(sizes, np.int32)
        hidden, actions = params["rnn.weight_hh"].shape[1], len(params["fc2.bias"])
        tape = Tape(inputs, counts, self._buffer(keep, self._tape(rows, hidden)))
        q = np.empty((rows, actions), np.float32)
        shape = (len(counts), counts, rows, inputs.shape[1], hidden, actions)
        self._forward(*shape, inputs, _pointers(params), q, tape.floats)
        return q, tape

    def backward(
        self, params: Mapping[str, Array], tape: Tape, grad_q: Array, out: Mapping[str, Array]
    ) -> None:
        """Fills the parameters' gradients ``out``, by name, from that of the action values."""
        (rows, inputs), counts = tape.inputs.shape, tape.sizes
        hidden, actions = params["rnn.weight_hh"].shape[1], grad_q.shape[1]
        shape = (len(counts), counts, rows, inputs, hidden, actions)
        grad_q = np.ascontiguousarray(grad_q)
        self._backward(
            *(*shape, tape.inputs, _pointers(params), tape.floats, grad_q, _pointers(out))
        )

    def _buffer(self, keep: bool, floats: int) -> Array:
        """Kept between calls: fresh pages cost more than the arithmetic on them."""
        if keep not in self._kept or len(self._kept[keep]) < floats:
            self._kept[keep] = np.empty(floats + floats // 4, np.float32)
        return self._kept[keep]


def _pointers(params: Mapping[str, Array]) -> Any:
    for name in NAMES:
        array = params[name]
        if array.dtype != np.float32 or not array.flags.c_contiguous:
            raise ValueError(f"{name} is {array.dtype}, contiguous {array.flags.c_contiguous}")
    return (ctypes.c_void_p * len(NAMES))(*(params[name].ctypes.data for name in NAMES))


@cache
def _loaded(name: str) -> Unroll:
    return Unroll(name)


def unroll() -> Unroll | None:
    """The kernel of this process; None: there is none."""
    name = build_name()
    return None if name is None else _loaded(name)
