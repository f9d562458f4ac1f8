"""Calls into the compiled kernels: shared memory, and what may be passed to them."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from policy_pkg import native
from policy_pkg.learner.memory import room

Tape = npt.NDArray[np.float32]
_POINTER = ctypes.c_void_p


def library(*tensors: Tensor) -> ctypes.CDLL | None:
    """The kernels for ``tensors``; None: torch has to do it (GPU, float64, no build)."""
    if not all(x.dtype is torch.float32 and x.is_cpu for x in tensors):
        return None
    return native.library()


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
