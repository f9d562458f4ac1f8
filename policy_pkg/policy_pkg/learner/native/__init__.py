"""The compiled unroll of the agent net: loads what set-up built of ``unroll.cpp``, if it did.

Two builds of one source, for AVX-512 and for AVX2, give the same bits; the machine's best is taken.
``CRASH_COACH_KERNEL`` (avx512, avx2, torch) asks for one.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import UserError

if TYPE_CHECKING:
    from torch import Tensor  # torch itself is not needed to say which build runs

Array = npt.NDArray[Any]
FOLDER = Path(sys.prefix) / "lib" / "crash_coach"
VARIABLE = "CRASH_COACH_KERNEL"
TORCH = "torch"
FLAGS = {"avx512": {"avx512f", "fma"}, "avx2": {"avx2", "fma"}}  # best first
_POINTER, _POINTERS, _INT = ctypes.c_void_p, ctypes.POINTER(ctypes.c_void_p), ctypes.c_int


def build_name() -> str | None:
    """Which build this process uses: avx512 or avx2; None: none, torch does it.

    Raises:
        UserError: CRASH_COACH_KERNEL asks for what is not there.
    """
    asked = os.environ.get(VARIABLE, "")
    if asked == TORCH:
        return None
    flags = _flags()
    able = [name for name, needed in FLAGS.items() if needed <= flags and _path(name).is_file()]
    if not asked:
        return able[0] if able else None
    if asked not in able:
        raise UserError(
            f"{VARIABLE}={asked}: this machine has {', '.join([*able, TORCH])}; "
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
    """Forward and backward over a packed batch; all tensors are float32 on the CPU, row-major.

    parameters: those of the agent net in the order fc1.weight, fc1.bias, rnn.weight_ih,
        rnn.weight_hh, rnn.bias_ih, rnn.bias_hh, fc2.weight, fc2.bias.
    counts: (T,) int32 rows at each time.
    """

    def __init__(self, name: str) -> None:
        library = ctypes.CDLL(str(_path(name)))
        self._floats, self._forward, self._backward = (
            library.unroll_tape,
            library.unroll_forward,
            library.unroll_backward,
        )
        sizes: list[Any] = [_INT, _POINTER, _INT, _INT, _INT, _INT]
        self._floats.argtypes, self._floats.restype = [_INT, _INT], ctypes.c_size_t
        self._forward.argtypes = [*sizes, _POINTER, _POINTERS, _POINTER, _POINTER]
        self._backward.argtypes = [*sizes, _POINTER, _POINTERS, _POINTER, _POINTER, _POINTERS]
        self._forward.restype = self._backward.restype = None
        self._free: list[Array] = []

    def tape(self, rows: int, hidden: int) -> Array:
        """Memory for what a forward pass leaves for the backward one; ``give_back`` it then.

        Kept between calls: fresh pages cost more than the arithmetic on them.
        """
        floats = self._floats(rows, hidden)
        while self._free:
            tape = self._free.pop()
            if len(tape) >= floats:
                return tape
        return np.empty(floats + floats // 4, np.float32)

    def give_back(self, tape: Array) -> None:
        self._free.append(tape)

    def forward(
        self, inputs: Tensor, counts: Tensor, parameters: Sequence[Tensor], tape: Array, q: Tensor
    ) -> None:
        """Fills ``tape`` and the action values ``q`` (R, A) of the packed rows (R, I)."""
        shape = _shape(inputs, counts, parameters)
        rows, filled = _address(inputs), _address(q)
        self._forward(*shape, rows, _addresses(parameters), filled, tape.ctypes.data)

    def backward(
        self,
        inputs: Tensor,
        counts: Tensor,
        parameters: Sequence[Tensor],
        tape: Array,
        grad_q: Tensor,
        out: Sequence[Tensor],
    ) -> None:
        """Fills the parameters' gradients ``out`` from that of the action values."""
        shape = _shape(inputs, counts, parameters)
        given = (_addresses(parameters), tape.ctypes.data, _address(grad_q), _addresses(out))
        self._backward(*shape, _address(inputs), *given)


def _shape(inputs: Tensor, counts: Tensor, parameters: Sequence[Tensor]) -> tuple[int, ...]:
    (rows, size), hidden, actions = inputs.shape, len(parameters[1]), len(parameters[-1])
    if str(counts.dtype) != "torch.int32" or not counts.is_contiguous():
        raise ValueError(f"counts are {counts.dtype}; must be torch.int32, contiguous")
    return len(counts), counts.data_ptr(), rows, size, hidden, actions


def _address(x: Tensor) -> int:
    if str(x.dtype) != "torch.float32" or not x.is_contiguous() or x.device.type != "cpu":
        raise ValueError(
            f"a tensor is {x.dtype} on {x.device}, contiguous {x.is_contiguous()}; "
            "the kernel takes contiguous torch.float32 on the CPU"
        )
    return x.data_ptr()


def _addresses(tensors: Sequence[Tensor]) -> Any:
    return (ctypes.c_void_p * len(tensors))(*map(_address, tensors))


@cache
def _loaded(name: str) -> Unroll:
    return Unroll(name)


def unroll() -> Unroll | None:
    """The kernel of this process; None: there is none."""
    name = build_name()
    return None if name is None else _loaded(name)
