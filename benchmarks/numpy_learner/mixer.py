"""The QMIX mixer: robots' action values to the team's (Rashid et al. 2018, section 4.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from benchmarks.numpy_learner.parameters import Shapes, linear
from policy_pkg.episode import Sizes

Array = npt.NDArray[Any]
Params = dict[str, Array]


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


@dataclass(frozen=True)
class Tape:
    """What the forward pass leaves for the backward one; W1 and W2 before the absolute value."""

    q: Array  # (M, n)
    state: Array  # (M, S)
    first: Array  # (M, 2 * hypernet + 2 * mixing), after the ReLU where there is one
    w1: Array  # (M, n * mixing)
    w2: Array  # (M, mixing)
    inner: Array  # (M, mixing) ELU's value


def _affine(params: Params, layer: str, x: Array) -> Array:
    out: Array = x @ params[f"{layer}.weight"].T
    out += params[f"{layer}.bias"]
    return out


def qmix(params: Params, q: Array, state: Array) -> tuple[Array, Tape]:
    """Q_tot = ELU(q |W1(s)| + b1(s)) |W2(s)| + V(s), monotonic in every robot's value.

    q: (M, n). state: (M, S). Returns (M,), and what ``qmix_gradients`` needs.
    """
    mixing, hypernet = params["w2.weight"].shape
    first = _affine(params, "state", state)
    rectified = first[:, : 2 * hypernet + mixing]
    np.maximum(rectified, 0, out=rectified)
    w1 = _affine(params, "w1", first[:, :hypernet])
    w2 = _affine(params, "w2", first[:, hypernet : 2 * hypernet])
    v = _affine(params, "v", first[:, 2 * hypernet : 2 * hypernet + mixing])[:, 0]
    inner = np.empty_like(w2)
    _mix(q, w1, first[:, 2 * hypernet + mixing :], inner)
    # ELU: x where x > 0, else exp(x) - 1
    # by tanh, whose bits do not depend on the processor as those of numpy's expm1 do
    half = np.tanh(np.minimum(inner, 0) / 2)
    inner = np.maximum(inner, 0) + 2 * half / (1 - half)
    total: Array = np.einsum("mk,mk->m", inner, np.abs(w2)) + v
    return total, Tape(q, state, first, w1, w2, inner)


def qmix_gradients(params: Params, tape: Tape, grad: Array, out: Params) -> Array:
    """Backward of ``qmix``: fills the parameters' gradients ``out``; returns that of q, (M, n).

    grad: (M,) of the loss with respect to Q_tot.
    """
    w1_w, w2_w, v_w = params["w1.weight"], params["w2.weight"], params["v.weight"]
    mixing, hypernet = w2_w.shape
    first, inner, column = tape.first, tape.inner, grad[:, np.newaxis]
    d_w2 = column * inner * np.sign(tape.w2)
    # d ELU(x) / dx = 1 where x > 0, else exp(x) = ELU(x) + 1
    d_inner = column * np.abs(tape.w2) * (np.minimum(inner, 0) + 1)
    d_q, d_w1 = np.empty_like(tape.q), np.empty_like(tape.w1)
    _unmix(tape.q, tape.w1, d_inner, d_q, d_w1)
    d_first = np.empty_like(first)
    np.matmul(d_w1, w1_w, out=d_first[:, :hypernet])
    np.matmul(d_w2, w2_w, out=d_first[:, hypernet : 2 * hypernet])
    np.multiply(column, v_w, out=d_first[:, 2 * hypernet : 2 * hypernet + mixing])
    rectified = 2 * hypernet + mixing
    d_first[:, :rectified] *= first[:, :rectified] > 0
    d_first[:, rectified:] = d_inner
    out["state.weight"][:] = d_first.T @ tape.state
    out["state.bias"][:] = d_first.sum(0)
    out["w1.weight"][:] = d_w1.T @ first[:, :hypernet]
    out["w1.bias"][:] = d_w1.sum(0)
    out["w2.weight"][:] = d_w2.T @ first[:, hypernet : 2 * hypernet]
    out["w2.bias"][:] = d_w2.sum(0)
    out["v.weight"][:] = grad @ first[:, 2 * hypernet : rectified]
    out["v.bias"][:] = grad.sum()
    return d_q


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
