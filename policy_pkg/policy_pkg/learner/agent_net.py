"""The agent net, Linear - ReLU - GRU - Linear, shared by all robots, over a packed batch.

On the CPU in float32 a compiled kernel unrolls it (``native``), forward and backward, as one
function to autograd; elsewhere torch's own GRU over a packed sequence does the same within
rounding: cuDNN's on a GPU, and in float64, where tests compare gradients.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from policy_pkg.episode import Sizes
from policy_pkg.learner.layers import Linear
from policy_pkg.learner.native.kernel import library
from policy_pkg.learner.native.unroll import unroll


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
        kernels = library(inputs)
        if kernels is None:
            return self._unrolled(inputs, counts)
        return unroll(kernels, inputs, counts, self._parameters_in_order())

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
