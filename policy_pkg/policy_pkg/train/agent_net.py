"""The agent net, Linear - ReLU - GRU - Linear, shared by all robots, over a packed batch."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from policy_pkg.train import packed_gru
from policy_pkg.train.episode import Sizes
from policy_pkg.train.packed_gru import Schedule
from policy_pkg.train.parameters import Shapes, linear

NAMES = (
    "fc1.weight",
    "fc1.bias",
    "rnn.weight_ih",
    "rnn.weight_hh",
    "rnn.bias_ih",
    "rnn.bias_hh",
    "fc2.weight",
    "fc2.bias",
)


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


def unroll(
    online: dict[str, Tensor],
    target: dict[str, Tensor],
    inputs: Tensor,
    taken: Tensor,
    schedule: Schedule,
) -> tuple[Tensor, Tensor, Tensor]:
    """Action values of the online and the target net for every packed row.

    inputs: (R, I). taken: (C,) int64 flat indexes into the (R, A) values.
    Returns the online net's values at ``taken`` (C,), which carry the gradient, and without
    gradient all values (R, A) of the online and of the target net.
    """
    taken_q, online_q, target_q = _Unroll.apply(
        *(inputs, taken, schedule, [target[name] for name in NAMES]),
        *(online[name] for name in NAMES),
    )
    return taken_q, online_q, target_q


class _Unroll(torch.autograd.Function):
    """Both nets side by side, since small operations cost more by their number than their size."""

    @staticmethod
    def forward(
        ctx: Any,
        inputs: Tensor,
        taken: Tensor,
        schedule: Schedule,
        target: list[Tensor],
        *online: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        fc1_w, fc1_b, w_ih, w_hh, b_ih, b_hh = (
            torch.stack(pair) for pair in zip(online[:6], target[:6], strict=True)
        )
        size = w_hh.shape[-1]
        embedded = torch.addmm(fc1_b.view(-1), inputs, fc1_w.view(2 * size, -1).t()).relu_()
        embedded_each = embedded.view(-1, 2, size).unbind(1)
        gates = packed_gru.gates_bias(b_ih, b_hh).unsqueeze(1).repeat(1, inputs.shape[0], 1)
        w_input = packed_gru.input_weight(w_ih)
        for net in range(2):
            gates[net, :, : 3 * size].addmm_(embedded_each[net], w_input[net].t())
        hidden = packed_gru.forward(gates, w_hh, schedule)
        online_q = torch.addmm(online[7], hidden[0], online[6].t())
        target_q = torch.addmm(target[7], hidden[1], target[6].t())
        ctx.save_for_backward(
            *(inputs, taken, embedded_each[0], gates[0], hidden[0], online[3], online[6]),
            w_input[0],
        )
        ctx.schedule = schedule
        ctx.mark_non_differentiable(online_q, target_q)
        ctx.set_materialize_grads(False)
        return online_q.view(-1).take(taken), online_q, target_q

    @staticmethod
    def backward(ctx: Any, grad_taken: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        inputs, taken, embedded, gates, hidden, w_hh, fc2_w, w_input = ctx.saved_tensors
        schedule: Schedule = ctx.schedule
        size = hidden.shape[1]
        grad_q = hidden.new_zeros(hidden.shape[0], fc2_w.shape[0])
        grad_q.view(-1).index_copy_(0, taken, grad_taken)
        before = _previous(hidden, schedule)
        grad_gates = packed_gru.backward(gates, before, w_hh, grad_q @ fc2_w, schedule)
        grad_in, grad_rec = grad_gates[:, : 3 * size], grad_gates[:, size:]
        grad_w_input = grad_in.t() @ embedded
        grad_embedded = grad_in @ w_input
        grad_fc1 = torch.ops.aten.threshold_backward(grad_embedded, embedded, 0)
        sums = grad_gates.sum(0)
        return (
            *(None, None, None, None),
            grad_fc1.t() @ inputs,
            grad_fc1.sum(0),
            grad_w_input.roll(-size, 0),
            grad_rec[schedule.first :].t() @ before,
            sums[: 3 * size].roll(-size, 0),
            sums[size:],
            grad_q.t() @ hidden,
            grad_q.sum(0),
        )


def _previous(hidden: Tensor, schedule: Schedule) -> Tensor:
    """(R, H) -> (R - first, H) the hidden state before each row of the times after 0."""
    steps = hidden.split_with_sizes(schedule.sizes)
    later = schedule.sizes[1:]
    return torch.cat([step[:rows] for step, rows in zip(steps, later, strict=False)])
