"""A GRU over a packed batch: one time step forward or backward, in numpy, without autograd.

Equations (torch.nn.GRU; gate order of the weights r, z, n), for input x and hidden state h::

    r = sigmoid(W_ir x + b_ir + W_hr h + b_hr)
    z = sigmoid(W_iz x + b_iz + W_hz h + b_hz)
    n = tanh(W_in x + b_in + r * (W_hn h + b_hn))
    h' = (1 - z) * n + z * h

sigmoid(x) = (1 + tanh(x / 2)) / 2, since numpy's tanh is vectorised and torch's is several times
slower; the halving is exact and sits in the prepared weights. numpy's BLAS also is the faster one
for these small matrices, and few rows at a time stay in the cache. The element-wise rest is
compiled, one pass per step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Schedule:
    """Rows of a packed sequence: time t has ``sizes[t]`` rows, never more than before.

    Row j of time t continues row j of time t - 1.
    """

    sizes: list[int]

    @property
    def rows(self) -> int:
        return sum(self.sizes)

    def slices(self) -> list[slice]:
        """The rows of each time."""
        ends = np.cumsum(self.sizes).tolist()
        return [slice(end - size, end) for end, size in zip(ends, self.sizes, strict=True)]


@dataclass(frozen=True)
class GruWeights:
    """Weights as the steps need them; made anew after every change of the parameters."""

    inputs: Array  # (H, 3H) W_i transposed, r and z halved
    recurrent: Array  # (H, 3H) W_h transposed, r and z halved
    bias: Array  # (4H,) halved sums for r and z, b_in, b_hn

    @classmethod
    def prepare(cls, w_ih: Array, w_hh: Array, b_ih: Array, b_hh: Array) -> GruWeights:
        size = w_hh.shape[1]
        bias = np.concatenate((b_ih + b_hh, b_hh[2 * size :]))
        bias[2 * size : 3 * size] = b_ih[2 * size :]
        bias[: 2 * size] /= 2
        inputs, recurrent = (np.ascontiguousarray(w.T) for w in (w_ih, w_hh))
        inputs[:, : 2 * size] /= 2
        recurrent[:, : 2 * size] /= 2
        return cls(inputs, recurrent, bias)


@dataclass(frozen=True)
class Gates:
    """What a forward pass leaves for the backward one, by row."""

    rz: Array  # (R, 2H)
    n: Array  # (R, H)
    n_hidden: Array  # (R, H) W_hn h + b_hn

    @classmethod
    def empty(cls, rows: int, size: int, dtype: npt.DTypeLike) -> Gates:
        return cls(
            np.empty((rows, 2 * size), dtype),
            np.empty((rows, size), dtype),
            np.empty((rows, size), dtype),
        )

    def of(self, rows: slice) -> Gates:
        return Gates(self.rz[rows], self.n[rows], self.n_hidden[rows])


def step(
    weights: GruWeights, x: Array, before: Array, out: Array, gates: Gates, scratch: Array
) -> None:
    """One time step of m rows: fills the hidden states ``out`` (m, H) and ``gates``.

    x, before: (m, H). scratch: (2, >= m, 3H).
    """
    rows = len(x)
    from_input, from_hidden = scratch[0, :rows], scratch[1, :rows]
    np.matmul(x, weights.inputs, out=from_input)
    np.matmul(before, weights.recurrent, out=from_hidden)
    _sum_gates(from_input, from_hidden, weights.bias, gates.rz, gates.n_hidden)
    np.tanh(gates.rz, out=gates.rz)
    _candidate(gates.rz, from_input, gates.n_hidden, weights.bias, gates.n)
    np.tanh(gates.n, out=gates.n)
    _blend(gates.n, gates.rz, before, out)


def step_back(
    w_hh: Array, gates: Gates, before: Array, grad: Array, out: Array, grad_before: Array
) -> None:
    """Backward of ``step``.

    grad: (m, H) of the loss with respect to the step's hidden states. out: (m, 4H), becomes the
    gradient with respect to [W_in x + b_in, the sums of r and z, W_hn h + b_hn], so that its first
    three blocks belong to the input product and its last three to the recurrent one.
    grad_before: (m, H), to which the gradient with respect to ``before`` is added.
    """
    _gate_gradients(grad, gates.rz, gates.n, gates.n_hidden, before, out, grad_before)
    grad_before += out[:, before.shape[1] :] @ w_hh


@njit(cache=True)
def _sum_gates(
    from_input: Array, from_hidden: Array, bias: Array, rz: Array, n_hidden: Array
) -> None:
    rows, size = n_hidden.shape
    for i in range(rows):
        for j in range(2 * size):
            rz[i, j] = from_input[i, j] + from_hidden[i, j] + bias[j]
        for j in range(size):
            n_hidden[i, j] = from_hidden[i, 2 * size + j] + bias[3 * size + j]


@njit(cache=True)
def _candidate(rz: Array, from_input: Array, n_hidden: Array, bias: Array, n: Array) -> None:
    rows, size = n.shape
    half = rz.dtype.type(0.5)
    for i in range(rows):
        for j in range(2 * size):
            rz[i, j] = half * rz[i, j] + half
        for j in range(size):
            n[i, j] = from_input[i, 2 * size + j] + bias[2 * size + j] + rz[i, j] * n_hidden[i, j]


@njit(cache=True)
def _blend(n: Array, rz: Array, before: Array, out: Array) -> None:
    rows, size = n.shape
    for i in range(rows):
        for j in range(size):
            out[i, j] = n[i, j] + rz[i, size + j] * (before[i, j] - n[i, j])


@njit(cache=True)
def _gate_gradients(
    grad: Array,
    rz: Array,
    n: Array,
    n_hidden: Array,
    before: Array,
    out: Array,
    grad_before: Array,
) -> None:
    rows, size = n.shape
    one = rz.dtype.type(1.0)
    # Two short loops and not one long: the compiler vectorises only what reads few arrays.
    for i in range(rows):
        for j in range(size):
            d_n = grad[i, j] * (one - rz[i, size + j]) * (one - n[i, j] * n[i, j])
            out[i, j] = d_n
            out[i, 3 * size + j] = d_n * rz[i, j]
        for j in range(size):
            out[i, size + j] = out[i, 3 * size + j] * n_hidden[i, j] * (one - rz[i, j])
        for j in range(size):
            g_z = grad[i, j] * rz[i, size + j]
            grad_before[i, j] += g_z
            out[i, 2 * size + j] = g_z * (before[i, j] - n[i, j]) * (one - rz[i, size + j])
