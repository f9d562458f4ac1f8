"""The agent net's compiled unroll over a packed batch, as one function to autograd.

    inputs: (R, I) packed rows, which get no gradient. counts: (T,) int32 rows at each time.
    parameters: fc1.weight, fc1.bias, rnn.weight_ih, rnn.weight_hh, rnn.bias_ih, rnn.bias_hh,
        fc2.weight, fc2.bias.

All tensors are contiguous, those but ``counts`` float32, and lie on the CPU.
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


def unroll(
    kernels: ctypes.CDLL, inputs: Tensor, counts: Tensor, parameters: Sequence[Tensor]
) -> Tensor:
    """Action values (R, A)."""
    if torch.is_grad_enabled() and parameters[0].requires_grad:
        q: Tensor = _Unroll.apply(kernels, inputs, counts, *parameters)
        return q
    return _forward(kernels, inputs, counts, parameters, None)


class _Unroll(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, kernels: ctypes.CDLL, inputs: Tensor, counts: Tensor, *parameters: Tensor
    ) -> Tensor:
        ctx.kernels = kernels
        ctx.tape = _TAPES.take(kernels.unroll_tape(len(inputs), len(parameters[1])))
        ctx.save_for_backward(inputs, counts, *parameters)
        return _forward(kernels, inputs, counts, parameters, ctx.tape.ctypes.data)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_q: Tensor) -> tuple[Tensor | None, ...]:
        inputs, counts, *parameters = ctx.saved_tensors
        if ctx.tape is None:
            raise RuntimeError("the agent net's tape is used up: call backward once")
        out = [torch.empty_like(parameter) for parameter in parameters]
        grad_q = grad_q.contiguous()
        ctx.kernels.unroll_backward(
            *_shape(inputs, counts, parameters),
            *(address(inputs), addresses(parameters), ctx.tape.ctypes.data),
            *(address(grad_q), addresses(out)),
        )
        _TAPES.give_back(ctx.tape)
        ctx.tape = None
        return (None, None, None, *out)


def _forward(
    kernels: ctypes.CDLL,
    inputs: Tensor,
    counts: Tensor,
    parameters: Sequence[Tensor],
    tape: int | None,
) -> Tensor:
    q = torch.empty((len(inputs), len(parameters[-1])))
    kernels.unroll_forward(
        *_shape(inputs, counts, parameters),
        *(address(inputs), addresses(parameters), address(q), tape),
    )
    return q


def _shape(inputs: Tensor, counts: Tensor, parameters: Sequence[Tensor]) -> tuple[int, ...]:
    (rows, size), hidden, actions = inputs.shape, len(parameters[1]), len(parameters[-1])
    if counts.dtype is not torch.int32 or not counts.is_contiguous():
        raise ValueError(f"counts are {counts.dtype}; must be torch.int32, contiguous")
    return len(counts), counts.data_ptr(), rows, size, hidden, actions
