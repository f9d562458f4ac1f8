"""The agent net, Linear - ReLU - GRU - Linear, shared by all robots, over a packed batch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from benchmarks.numpy_learner import packed_gru
from benchmarks.numpy_learner.packed_gru import Gates, GruWeights, Schedule
from benchmarks.numpy_learner.parameters import Shapes, linear
from policy_pkg.episode import Sizes

Array = npt.NDArray[Any]
Params = dict[str, Array]


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


@dataclass(frozen=True)
class Tape:
    """What a forward pass leaves for the backward one, by packed row."""

    inputs: Array  # (R, I)
    schedule: Schedule
    embedded: Array  # (R, H) after the ReLU
    gates: Gates
    hidden: Array  # (R, H)


def values(params: Params, inputs: Array, schedule: Schedule) -> Array:
    """Action values (R, A) of the packed rows ``inputs`` (R, I)."""
    hidden, _, _ = _unroll(params, inputs, schedule, keep=False)
    return _output(params, hidden)


def values_and_tape(params: Params, inputs: Array, schedule: Schedule) -> tuple[Array, Tape]:
    """As ``values``, with what ``gradients`` needs."""
    hidden, embedded, gates = _unroll(params, inputs, schedule, keep=True)
    return _output(params, hidden), Tape(inputs, schedule, embedded, gates, hidden)


def _output(params: Params, hidden: Array) -> Array:
    q: Array = hidden @ params["fc2.weight"].T
    q += params["fc2.bias"]
    return q


def _unroll(
    params: Params, inputs: Array, schedule: Schedule, keep: bool
) -> tuple[Array, Array, Gates]:
    """Hidden states (R, H); embedded inputs and gates of all rows, or scratch without ``keep``."""
    w_ih, w_hh = params["rnn.weight_ih"], params["rnn.weight_hh"]
    size, dtype, most = w_hh.shape[1], w_hh.dtype, schedule.sizes[0]
    weights = GruWeights.prepare(w_ih, w_hh, params["rnn.bias_ih"], params["rnn.bias_hh"])
    fc1 = np.ascontiguousarray(params["fc1.weight"].T)
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
        _bias_relu(x, params["fc1.bias"])
        out = hidden[rows]
        packed_gru.step(weights, x, before[:count], out, gates.of(place), scratch)
        before = out
    return hidden, embedded, gates


def gradients(params: Params, tape: Tape, grad_q: Array, out: Params) -> None:
    """Backward of ``values_and_tape``: fills the parameters' gradients ``out``, by name.

    grad_q: (R, A) of the loss with respect to the action values.
    """
    w_ih, w_hh, fc2_w = params["rnn.weight_ih"], params["rnn.weight_hh"], params["fc2.weight"]
    schedule, hidden, embedded, gates = tape.schedule, tape.hidden, tape.embedded, tape.gates
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
        sums = grad_gates[rows]
        packed_gru.step_back(w_hh, gates.of(rows), before, grad_hidden[rows], sums, into)
        np.matmul(sums[:, : 3 * size], w_input, out=grad_embedded[rows])
        _relu_back(grad_embedded[rows], embedded[rows])
    grad_w_input = (embedded.T @ grad_gates[:, : 3 * size]).T
    bias = grad_gates.sum(0)
    out["fc1.weight"][:] = (tape.inputs.T @ grad_embedded).T
    out["fc1.bias"][:] = grad_embedded.sum(0)
    out["rnn.weight_ih"][:] = np.roll(grad_w_input, -size, 0)
    out["rnn.weight_hh"][:] = (previous.T @ grad_gates[:, size:]).T
    out["rnn.bias_ih"][:] = np.roll(bias[: 3 * size], -size)
    out["rnn.bias_hh"][:] = bias[size:]
    out["fc2.weight"][:] = grad_q.T @ hidden
    out["fc2.bias"][:] = grad_q.sum(0)


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
