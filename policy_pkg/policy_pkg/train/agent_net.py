"""The agent net, Linear - ReLU - GRU - Linear, shared by all robots, over a packed batch."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from numba import njit
from torch import Tensor

from policy_pkg.train import packed_gru
from policy_pkg.train.episode import Sizes
from policy_pkg.train.packed_gru import Gates, GruWeights, Schedule
from policy_pkg.train.parameters import Shapes, linear

Array = npt.NDArray[Any]


def shapes(sizes: Sizes, hidden: int) -> tuple[Shapes, dict[str, int]]:
    """Parameters by name (torch's layout), and the fan-in of each layer."""
    gates = 3 * hidden
    named = {
        **linear("fc1", sizes.input_size, hidden),
        "rnn.weight_ih": (gates, hidden),
        "rnn.weight_hh": (gates, hidden),
        "rnn.bias_ih": (gates,),
        "rnn.bias_hh": (gates,),
        **linear("fc2", hidden, sizes.n_actions),
    }
    return named, {"fc1": sizes.input_size, "rnn": hidden, "fc2": hidden}


def unroll(params: dict[str, Tensor], inputs: Tensor, schedule: Schedule) -> Tensor:
    """Action values (R, A) of the packed rows ``inputs`` (R, I), with gradient by autograd."""
    q: Tensor = _Unroll.apply(inputs, schedule, *params.values())
    return q


def unroll_values(params: dict[str, Tensor], inputs: Tensor, schedule: Schedule) -> Tensor:
    """As ``unroll``, without gradient and without keeping anything for one."""
    arrays = [param.detach().numpy() for param in params.values()]
    hidden, _, _ = _forward(arrays, inputs.numpy(), schedule, keep=False)
    return _values(arrays, hidden)


def _values(params: list[Array], hidden: Array) -> Tensor:
    q = hidden @ params[6].T
    q += params[7]
    return torch.from_numpy(q)


class _Unroll(torch.autograd.Function):
    """Whole sequences as one operation, so that autograd records nothing per time step."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, schedule: Schedule, *params: Tensor) -> Tensor:
        arrays = [param.numpy() for param in params]
        hidden, embedded, gates = _forward(arrays, inputs.numpy(), schedule, keep=True)
        # Not ctx.save_for_backward: these are numpy arrays that nothing else can change.
        ctx.saved = (arrays, inputs.numpy(), schedule, hidden, embedded, gates)
        return _values(arrays, hidden)

    @staticmethod
    def backward(ctx: Any, grad_q: Tensor) -> tuple[Tensor | None, ...]:
        grads = _backward(grad_q.numpy(), *ctx.saved)
        return (None, None, *(torch.from_numpy(grad) for grad in grads))


def _forward(
    params: list[Array], inputs: Array, schedule: Schedule, keep: bool
) -> tuple[Array, Array, Gates]:
    """Hidden states (R, H); embedded inputs and gates of all rows, or scratch without ``keep``."""
    fc1_w, fc1_b, w_ih, w_hh, b_ih, b_hh = params[:6]
    size, dtype, most = w_hh.shape[1], w_hh.dtype, schedule.sizes[0]
    weights = GruWeights.prepare(w_ih, w_hh, b_ih, b_hh)
    fc1 = np.ascontiguousarray(fc1_w.T)
    hidden = np.empty((schedule.rows, size), dtype)
    kept = schedule.rows if keep else most
    embedded, gates = np.empty((kept, size), dtype), Gates.empty(kept, size, dtype)
    scratch = np.empty((2, most, 3 * size), dtype)
    before = np.zeros((most, size), dtype)
    for rows in schedule.slices():
        count = rows.stop - rows.start
        place = rows if keep else slice(0, count)
        x = embedded[place]
        np.matmul(inputs[rows], fc1, out=x)
        _bias_relu(x, fc1_b)
        out = hidden[rows]
        packed_gru.step(weights, x, before[:count], out, gates.of(place), scratch)
        before = out
    return hidden, embedded, gates


def _backward(
    grad_q: Array,
    params: list[Array],
    inputs: Array,
    schedule: Schedule,
    hidden: Array,
    embedded: Array,
    gates: Gates,
) -> list[Array]:
    """Gradients of the parameters, in their order."""
    w_ih, w_hh, fc2_w = params[2], params[3], params[6]
    size, most = hidden.shape[1], schedule.sizes[0]
    w_input = np.roll(w_ih, size, 0)  # r, z, n -> n, r, z, the order of the gates' gradients
    grad_hidden = grad_q @ fc2_w
    grad_gates = np.empty((len(hidden), 4 * size), hidden.dtype)
    grad_embedded = np.empty_like(embedded)
    previous = np.zeros_like(hidden)
    start = np.zeros((most, size), hidden.dtype)
    slices = schedule.slices()
    for t in range(len(slices) - 1, -1, -1):
        rows = slices[t]
        earlier = slice(slices[t - 1].start, slices[t - 1].start + schedule.sizes[t])
        before = hidden[earlier] if t else start
        previous[rows] = before
        into = grad_hidden[earlier] if t else start.copy()
        out = grad_gates[rows]
        packed_gru.step_back(w_hh, gates.of(rows), before, grad_hidden[rows], out, into)
        np.matmul(out[:, : 3 * size], w_input, out=grad_embedded[rows])
        _relu_back(grad_embedded[rows], embedded[rows])
    sums = grad_gates.sum(0)
    return [
        (inputs.T @ grad_embedded).T,
        grad_embedded.sum(0),
        np.roll((embedded.T @ grad_gates[:, : 3 * size]).T, -size, 0),
        (previous.T @ grad_gates[:, size:]).T,
        np.roll(sums[: 3 * size], -size),
        sums[size:],
        grad_q.T @ hidden,
        grad_q.sum(0),
    ]


@njit(cache=True)
def _bias_relu(x: Array, bias: Array) -> None:
    zero = bias.dtype.type(0.0)
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            x[i, j] = max(x[i, j] + bias[j], zero)


@njit(cache=True)
def _relu_back(grad: Array, value: Array) -> None:
    zero = grad.dtype.type(0.0)
    for i in range(grad.shape[0]):
        for j in range(grad.shape[1]):
            if value[i, j] <= zero:
                grad[i, j] = zero
