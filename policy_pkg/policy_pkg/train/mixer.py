"""Mixers: robots' action values to the team's. QMIX (Rashid et al. 2018, section 4.1), VDN."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from numba import njit
from torch import Tensor

from policy_pkg.train.episode import Sizes
from policy_pkg.train.parameters import Shapes, linear

Array = npt.NDArray[Any]


def qmix_shapes(sizes: Sizes, mixing: int, hypernet: int) -> tuple[Shapes, dict[str, int]]:
    """Parameters of the hypernetworks by name, and the fan-in of each layer.

    ``state`` holds the first layers of W1, W2 and V, and b1, one under the other: they read
    the same state, so they are one matrix product.
    """
    first = 2 * hypernet + 2 * mixing
    named = {
        **linear("state", sizes.state_size, first),
        **linear("w1", hypernet, sizes.n_robots * mixing),
        **linear("w2", hypernet, mixing),
        **linear("v", mixing, 1),
    }
    fan_in = {"state": sizes.state_size, "w1": hypernet, "w2": hypernet, "v": mixing}
    return named, fan_in


def qmix(params: dict[str, Tensor], q: Tensor, state: Tensor) -> Tensor:
    """Q_tot = ELU(q |W1(s)| + b1(s)) |W2(s)| + V(s), monotonic in every robot's value.

    q: (M, n). state: (M, S), without gradient. Returns (M,).
    """
    total: Tensor = _Qmix.apply(q, state, *params.values())
    return total


def vdn(q: Tensor) -> Tensor:
    """Q_tot = sum of the robots' values (Sunehag et al. 2018). q: (M, n). Returns (M,)."""
    return q.sum(1)


@dataclass(frozen=True)
class _Pass:
    """What the forward pass leaves for the backward one; W1 and W2 before the absolute value."""

    q: Array  # (M, n)
    state: Array  # (M, S)
    first: Array  # (M, 2 * hypernet + 2 * mixing), after the ReLU where there is one
    w1: Array  # (M, n * mixing)
    w2: Array  # (M, mixing)
    inner: Array  # (M, mixing) ELU's value


class _Qmix(torch.autograd.Function):
    """The whole mixer as one operation; its small steps would cost more by their number."""

    @staticmethod
    def forward(ctx: Any, q: Tensor, state: Tensor, *params: Tensor) -> Tensor:
        ctx.params = [param.numpy() for param in params]
        total, ctx.saved = _forward(ctx.params, q.numpy(), state.numpy())
        return torch.from_numpy(total)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        grad_q, *grads = _backward(ctx.params, ctx.saved, grad.numpy())
        return (torch.from_numpy(grad_q), None, *(torch.from_numpy(g) for g in grads))


def _affine(x: Array, weight: Array, bias: Array) -> Array:
    out: Array = x @ weight.T
    out += bias
    return out


def _forward(params: list[Array], q: Array, state: Array) -> tuple[Array, _Pass]:
    state_w, state_b, w1_w, w1_b, w2_w, w2_b, v_w, v_b = params
    mixing, hypernet = w2_w.shape
    first = _affine(state, state_w, state_b)
    rectified = first[:, : 2 * hypernet + mixing]
    np.maximum(rectified, 0, out=rectified)
    w1 = _affine(first[:, :hypernet], w1_w, w1_b)
    w2 = _affine(first[:, hypernet : 2 * hypernet], w2_w, w2_b)
    total: Array = _affine(first[:, 2 * hypernet : 2 * hypernet + mixing], v_w, v_b)[:, 0]
    inner = np.empty_like(w2)
    _mix(q, w1, first[:, 2 * hypernet + mixing :], inner)
    # ELU: x where x > 0, else exp(x) - 1
    inner = np.maximum(inner, 0) + np.expm1(np.minimum(inner, 0))
    total = total + np.einsum("mk,mk->m", inner, np.abs(w2))
    return total, _Pass(q, state, first, w1, w2, inner)


def _backward(params: list[Array], saved: _Pass, grad: Array) -> list[Array]:
    """Gradients of q and then of the parameters in their order. grad: (M,)."""
    _, _, w1_w, _, w2_w, _, v_w, _ = params
    mixing, hypernet = w2_w.shape
    first, inner, column = saved.first, saved.inner, grad[:, np.newaxis]
    d_w2 = column * inner * np.sign(saved.w2)
    # d ELU(x) / dx = 1 where x > 0, else exp(x) = ELU(x) + 1
    d_inner = column * np.abs(saved.w2) * (np.minimum(inner, 0) + 1)
    d_q, d_w1 = np.empty_like(saved.q), np.empty_like(saved.w1)
    _unmix(saved.q, saved.w1, d_inner, d_q, d_w1)
    d_first = np.empty_like(first)
    np.matmul(d_w1, w1_w, out=d_first[:, :hypernet])
    np.matmul(d_w2, w2_w, out=d_first[:, hypernet : 2 * hypernet])
    np.multiply(column, v_w, out=d_first[:, 2 * hypernet : 2 * hypernet + mixing])
    rectified = 2 * hypernet + mixing
    d_first[:, :rectified] *= first[:, :rectified] > 0
    d_first[:, rectified:] = d_inner
    return [
        d_q,
        d_first.T @ saved.state,
        d_first.sum(0),
        d_w1.T @ first[:, :hypernet],
        d_w1.sum(0),
        d_w2.T @ first[:, hypernet : 2 * hypernet],
        d_w2.sum(0),
        grad[np.newaxis] @ first[:, 2 * hypernet : rectified],
        grad.sum(keepdims=True),
    ]


@njit(cache=True)
def _mix(q: Array, w1: Array, b1: Array, out: Array) -> None:
    """out = q |W1| + b1 for each row."""
    rows, mixing = out.shape
    for m in range(rows):
        for k in range(mixing):
            out[m, k] = b1[m, k]
        for robot in range(q.shape[1]):
            value = q[m, robot]
            for k in range(mixing):
                out[m, k] += value * abs(w1[m, robot * mixing + k])


@njit(cache=True)
def _unmix(q: Array, w1: Array, d_inner: Array, d_q: Array, d_w1: Array) -> None:
    """Gradients of q and W1 from that of q |W1| + b1."""
    rows, mixing = d_inner.shape
    for m in range(rows):
        for robot in range(q.shape[1]):
            value, total = q[m, robot], q.dtype.type(0)
            for k in range(mixing):
                weight, slope = w1[m, robot * mixing + k], d_inner[m, k]
                total += slope * abs(weight)
                d_w1[m, robot * mixing + k] = slope * np.sign(weight) * value
            d_q[m, robot] = total
