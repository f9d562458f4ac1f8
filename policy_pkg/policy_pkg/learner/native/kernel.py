"""Calls into the compiled kernels: shared memory, and what may be passed to them."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from policy_pkg import native
from policy_pkg.learner.memory import room

Tape = npt.NDArray[np.float32]
_INT, _POINTER = ctypes.c_int, ctypes.c_void_p
_UNROLL: list[Any] = [_INT, _POINTER, _INT, _INT, _INT, _INT]
_QMIX: list[Any] = [_INT] * 5
# by function: how it begins, and how many pointers follow
_ARGUMENTS = {
    "unroll_forward": (_UNROLL, 4),
    "unroll_backward": (_UNROLL, 5),
    "qmix_forward": (_QMIX, 5),
    "qmix_backward": (_QMIX, 7),
}
_TAPES = {"unroll_tape": 2, "qmix_tape": 5}  # by function: how many numbers it takes


@cache
def _loaded(name: str, folder: Path) -> ctypes.CDLL:
    found = ctypes.CDLL(str(native.path(name, folder)))
    for function, (sizes, pointers) in _ARGUMENTS.items():
        getattr(found, function).argtypes = sizes + [_POINTER] * pointers
        getattr(found, function).restype = None
    for function, numbers in _TAPES.items():
        getattr(found, function).argtypes = [_INT] * numbers
        getattr(found, function).restype = ctypes.c_size_t
    return found


def library(*tensors: Tensor) -> ctypes.CDLL | None:
    """The kernels for ``tensors``; None: torch has to do it (GPU, float64, no build)."""
    if not all(x.dtype is torch.float32 and x.is_cpu for x in tensors):
        return None
    name = native.build_name()
    return None if name is None else _loaded(name, native.FOLDER)


class Tapes:
    """Memory for what forward passes leave for backward ones."""

    def __init__(self) -> None:
        self._free: list[Tape] = []

    def take(self, floats: int) -> Tape:
        """At least so many floats; ``give_back`` them after the backward pass."""
        while self._free:
            tape = self._free.pop()
            if len(tape) >= floats:
                return tape
        memory = room(4 * floats)
        return memory[: len(memory) // 4 * 4].view(np.float32)

    def give_back(self, tape: Tape) -> None:
        self._free.append(tape)


def address(x: Tensor) -> int:
    """Of a contiguous float32 tensor on the CPU.

    Raises:
        ValueError: it is not one.
    """
    if x.dtype is not torch.float32 or not x.is_cpu or not x.is_contiguous():
        raise ValueError(
            f"a tensor is {x.dtype} on {x.device}, contiguous {x.is_contiguous()}; "
            "the kernel takes contiguous torch.float32 on the CPU"
        )
    return x.data_ptr()


def addresses(tensors: Sequence[Tensor]) -> Any:
    """Of several, as an array of pointers."""
    return (_POINTER * len(tensors))(*map(address, tensors))
