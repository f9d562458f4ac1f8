"""A linear layer that gives the same bits on every processor with AVX2.

torch's own goes to MKL, which sums in an order that it picks by the processor. This one uses
numpy's BLAS, which ``policy_pkg.kernels`` pins; on a GPU, torch's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

Array = npt.NDArray[Any]
DTYPES = {"float32": torch.float32, "float64": torch.float64}


class Linear(nn.Linear):
    """torch.nn.Linear for (M, in) -> (M, out), with reproducible bits on the CPU."""

    def forward(self, x: Tensor) -> Tensor:
        if x.device.type != "cpu":
            return super().forward(x)
        if not torch.is_grad_enabled():
            return _affine(x, self.weight, self.bias)
        out: Tensor = _Affine.apply(x, self.weight, self.bias)
        return out


class _Affine(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight)
        return _affine(x, weight, bias)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        x, weight = (tensor.detach().numpy() for tensor in ctx.saved_tensors)
        above = grad.contiguous().numpy()
        grad_x = _product(above, weight) if ctx.needs_input_grad[0] else None
        return grad_x, _product(above.T, x), grad.sum(0)


def _affine(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    return _product(x.detach().numpy(), weight.detach().numpy().T).add_(bias.detach())


def _product(a: Array, b: Array) -> Tensor:
    out = torch.empty((a.shape[0], b.shape[1]), dtype=DTYPES[a.dtype.name])  # aligned, for BLAS
    np.matmul(a, b, out=out.numpy())
    return out
