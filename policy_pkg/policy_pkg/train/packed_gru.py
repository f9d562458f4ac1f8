"""A GRU over a packed batch: forward and backward of whole sequences, without autograd.

Equations (torch.nn.GRU; gate order of the weights r, z, n), for input x and hidden state h::

    r = sigmoid(W_ir x + b_ir + W_hr h + b_hr)
    z = sigmoid(W_iz x + b_iz + W_hz h + b_hz)
    n = tanh(W_in x + b_in + r * (W_hn h + b_hn))
    h' = (1 - z) * n + z * h

All that does not depend on h is done once for every packed row; the loop over time holds only
the recurrent product and the gates, in place. The gates lie in one array in the order
[n, r, z, W_hn h + b_hn]: its first three blocks take the input product, its last three the
recurrent one, and both are single matrix products.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Schedule:
    """Rows of a packed sequence: time t has ``sizes[t]`` rows, never more than before.

    Row j of time t continues row j of time t - 1.
    """

    sizes: list[int]

    @property
    def first(self) -> int:
        """Rows of time 0, which have no predecessor."""
        return self.sizes[0]


def input_weight(weight_ih: Tensor) -> Tensor:
    """(..., 3H, H) in torch's order r, z, n -> n, r, z, the order of the gates' first blocks."""
    return weight_ih.roll(weight_ih.shape[-1], -2)


def gates_bias(bias_ih: Tensor, bias_hh: Tensor) -> Tensor:
    """(..., 3H) twice -> (..., 4H): what the gates' blocks start from, before any product."""
    hidden = bias_ih.shape[-1] // 3
    rz_in, n_in = bias_ih.split_with_sizes((2 * hidden, hidden), -1)
    rz_hid, n_hid = bias_hh.split_with_sizes((2 * hidden, hidden), -1)
    return torch.cat((n_in, rz_in + rz_hid, n_hid), -1)


def forward(gates: Tensor, weight_hh: Tensor, schedule: Schedule) -> Tensor:
    """Unrolls K nets side by side from zero hidden states.

    gates: (K, R, 4H) biases and input products; overwritten by the gates' values.
    weight_hh: (K, 3H, H). Returns the hidden states (K, R, H).
    """
    nets, rows, width = gates.shape
    size = width // 4
    hidden = gates.new_empty(nets, rows, size)
    steps = hidden.split_with_sizes(schedule.sizes, 1)
    recurrent = gates[:, :, size:].split_with_sizes(schedule.sizes, 1)
    sigmoids = gates[:, :, size : 3 * size].split_with_sizes(schedule.sizes, 1)
    n, r, z, n_hidden = (block.split_with_sizes(schedule.sizes, 1) for block in gates.chunk(4, 2))
    product = weight_hh.transpose(1, 2)
    for t, rows_now in enumerate(schedule.sizes):
        if t == 0:
            sigmoids[t].sigmoid_()
            n[t].addcmul_(r[t], n_hidden[t]).tanh_()
            torch.addcmul(n[t], n[t], z[t], value=-1, out=steps[t])
        else:
            before = steps[t - 1].narrow(1, 0, rows_now)
            recurrent[t].baddbmm_(before, product)
            sigmoids[t].sigmoid_()
            n[t].addcmul_(r[t], n_hidden[t]).tanh_()
            torch.lerp(n[t], before, z[t], out=steps[t])
    return hidden


def backward(
    gates: Tensor, before: Tensor, weight_hh: Tensor, grad: Tensor, schedule: Schedule
) -> Tensor:
    """Gradient of the loss with respect to the gates' sums, (R, 4H), blocks as in ``gates``.

    gates: (R, 4H) values that ``forward`` left, for one net.
    before: (R - first, H) hidden states before each row of the times after 0.
    weight_hh: (3H, H). grad: (R, H) with respect to the hidden states; overwritten.
    """
    size = before.shape[1]
    out = _local_gradients(gates, before, schedule.first)
    z = gates[:, 2 * size : 3 * size].split_with_sizes(schedule.sizes)
    blocks = out.view(-1, 4, size).split_with_sizes(schedule.sizes)
    recurrent = out[:, size:].split_with_sizes(schedule.sizes)
    grads = grad.split_with_sizes(schedule.sizes)
    wide = grad.unsqueeze(1).split_with_sizes(schedule.sizes)
    for t in range(len(schedule.sizes) - 1, -1, -1):
        blocks[t].mul_(wide[t])
        if t > 0:
            into = grads[t - 1].narrow(0, 0, schedule.sizes[t])
            into.addcmul_(grads[t], z[t]).addmm_(recurrent[t], weight_hh)
    return out


def _local_gradients(gates: Tensor, before: Tensor, first: int) -> Tensor:
    """d h' / d (sums of the gates) of each row on its own, (R, 4H)."""
    n, r, z, n_hidden = gates.chunk(4, 1)
    out = torch.empty_like(gates)
    d_n, d_r, d_z, d_hidden = out.chunk(4, 1)
    z_left = 1 - z
    torch.mul(n, n, out=d_n)
    torch.addcmul(z_left, z_left, d_n, value=-1, out=d_n)  # (1 - z) (1 - n^2)
    torch.mul(d_n, r, out=d_hidden)
    torch.addcmul(d_hidden, d_hidden, r, value=-1, out=d_r).mul_(n_hidden)
    torch.mul(z, z_left, out=d_z)
    d_z[:first].mul_(n[:first].neg())
    d_z[first:].mul_(before - n[first:])
    return out
