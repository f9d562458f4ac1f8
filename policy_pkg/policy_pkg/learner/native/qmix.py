"""QMIX's compiled mixer, as one function to autograd.

    values: (M, n) of the robots. state: (M, S), which gets no gradient.
    parameters: state.weight, state.bias, w1.weight, w1.bias, w2.weight, w2.bias, v.weight, v.bias.

All tensors are contiguous float32 on the CPU.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from policy_pkg.learner.native.kernel import Tapes, address, addresses

_TAPES = Tapes()


def qmix(
    kernels: ctypes.CDLL, values: Tensor, state: Tensor, parameters: Sequence[Tensor]
) -> Tensor:
    """(M,) values of the team."""
    values, state = values.contiguous(), state.contiguous()
    if torch.is_grad_enabled() and (values.requires_grad or parameters[0].requires_grad):
        total: Tensor = _Qmix.apply(kernels, values, state, *parameters)
        return total
    return _forward(kernels, values, state, parameters, None)


class _Qmix(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, kernels: ctypes.CDLL, values: Tensor, state: Tensor, *parameters: Tensor
    ) -> Tensor:
        ctx.kernels = kernels
        ctx.tape = _TAPES.take(kernels.qmix_tape(*_shape(values, state, parameters)))
        ctx.save_for_backward(values, state, *parameters)
        return _forward(kernels, values, state, parameters, ctx.tape.ctypes.data)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        values, state, *parameters = ctx.saved_tensors
        if ctx.tape is None:
            raise RuntimeError("the mixer's tape is used up: call backward once")
        grad_values = torch.empty_like(values)
        out = [torch.empty_like(parameter) for parameter in parameters]
        grad = grad.contiguous()
        ctx.kernels.qmix_backward(
            *_shape(values, state, parameters),
            *(address(values), address(state), addresses(parameters), ctx.tape.ctypes.data),
            *(address(grad), address(grad_values), addresses(out)),
        )
        _TAPES.give_back(ctx.tape)
        ctx.tape = None
        return (None, grad_values, None, *out)


def _forward(
    kernels: ctypes.CDLL,
    values: Tensor,
    state: Tensor,
    parameters: Sequence[Tensor],
    tape: int | None,
) -> Tensor:
    total = torch.empty(len(values))
    kernels.qmix_forward(
        *_shape(values, state, parameters),
        *(address(values), address(state), addresses(parameters), address(total), tape),
    )
    return total


def _shape(values: Tensor, state: Tensor, parameters: Sequence[Tensor]) -> tuple[int, ...]:
    (rows, robots), (mixing, hypernet) = values.shape, parameters[4].shape
    return rows, robots, state.shape[1], mixing, hypernet
