"""The agent net, Linear - ReLU - GRU - Linear, shared by all robots, over a packed batch.

On the CPU in float32 the compiled kernel unrolls it (``native``), forward and backward, as one
function to autograd; elsewhere torch's own GRU over a packed sequence does the same within
rounding: cuDNN's on a GPU, and in float64, where tests compare gradients.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from policy_pkg.episode import Sizes
from policy_pkg.learner import native
from policy_pkg.learner.layers import Linear


class AgentNet(nn.Module):
    """Parameters as torch names and shapes them; as PyMARL's RNNAgent."""

    def __init__(self, sizes: Sizes, hidden: int) -> None:
        super().__init__()
        self.fc1 = Linear(sizes.input_size, hidden)
        self.rnn = nn.GRUCell(hidden, hidden)
        self.fc2 = Linear(hidden, sizes.n_actions)

    def forward(self, inputs: Tensor, counts: Tensor) -> Tensor:
        """Action values (R, A) of the packed rows ``inputs`` (R, I), which get no gradient.

        counts: (T,) int32 on the CPU, rows at each time, never more than before: row j of time t
            continues row j of time t - 1. All start from a hidden state of zeros.
        """
        kernel = None
        if inputs.device.type == "cpu" and inputs.dtype == torch.float32:
            kernel = native.unroll()
        if kernel is None:
            return self._unrolled(inputs, counts)
        parameters = self._parameters_in_order()
        if torch.is_grad_enabled() and parameters[0].requires_grad:
            q: Tensor = _Unroll.apply(kernel, inputs, counts, *parameters)
            return q
        return _forward(kernel, inputs, counts, parameters)[0]

    def _parameters_in_order(self) -> list[Tensor]:
        rnn = self.rnn
        return [
            *(self.fc1.weight, self.fc1.bias),
            *(rnn.weight_ih, rnn.weight_hh, rnn.bias_ih, rnn.bias_hh),
            *(self.fc2.weight, self.fc2.bias),
        ]

    def _unrolled(self, inputs: Tensor, counts: Tensor) -> Tensor:
        embedded = torch.relu(self.fc1(inputs))
        start = embedded.new_zeros((1, int(counts[0]), embedded.shape[1]))
        weights = self._parameters_in_order()[2:6]
        settings: tuple[Any, ...] = (True, 1, 0.0, self.training, False)  # one layer, one way
        hidden, _ = torch.gru(embedded, counts.long(), start, weights, *settings)
        q: Tensor = self.fc2(hidden)
        return q


class _Unroll(torch.autograd.Function):
    """The kernel's forward and backward pass over a whole packed batch."""

    @staticmethod
    def forward(
        ctx: Any, kernel: native.Unroll, inputs: Tensor, counts: Tensor, *parameters: Tensor
    ) -> Tensor:
        q, tape = _forward(kernel, inputs, counts, parameters, keep=True)
        ctx.kernel, ctx.tape = kernel, tape
        ctx.save_for_backward(inputs, counts, *parameters)
        return q

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_q: Tensor) -> tuple[Tensor | None, ...]:
        inputs, counts, *parameters = ctx.saved_tensors
        if ctx.tape is None:
            raise RuntimeError("the agent net's tape is used up: call backward once")
        out = [torch.empty_like(parameter) for parameter in parameters]
        grad_q = grad_q.contiguous()
        ctx.kernel.backward(inputs, counts, parameters, ctx.tape, grad_q, out)
        ctx.kernel.give_back(ctx.tape)
        ctx.tape = None
        return (None, None, None, *out)


def _forward(
    kernel: native.Unroll, inputs: Tensor, counts: Tensor, parameters: Any, keep: bool = False
) -> tuple[Tensor, Any]:
    """Action values, and the tape where it is to be kept."""
    q = torch.empty((len(inputs), len(parameters[-1])), dtype=inputs.dtype)
    tape = kernel.tape(len(inputs), parameters[1].shape[0])
    kernel.forward(inputs, counts, parameters, tape, q)
    if keep:
        return q, tape
    kernel.give_back(tape)
    return q, None
