"""Mixers: robots' action values to the team's. QMIX (Rashid et al. 2018, section 4.1), VDN."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from policy_pkg.train.episode import Sizes
from policy_pkg.train.parameters import Shapes, linear


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

    q: (M, n). state: (M, S). Returns (M,).
    """
    mixing, hypernet = params["w2.weight"].shape
    first = F.linear(state, params["state.weight"], params["state.bias"])
    relu, b1 = first.split_with_sizes((2 * hypernet + mixing, mixing), 1)
    w1_in, w2_in, v_in = relu.relu().split_with_sizes((hypernet, hypernet, mixing), 1)
    w1 = F.linear(w1_in, params["w1.weight"], params["w1.bias"]).abs()
    w2 = F.linear(w2_in, params["w2.weight"], params["w2.bias"]).abs()
    v = F.linear(v_in, params["v.weight"], params["v.bias"])
    inner = (q.unsqueeze(2) * w1.view(q.shape[0], q.shape[1], mixing)).sum(1)
    return (F.elu(inner + b1) * w2).sum(1) + v.squeeze(1)


def vdn(q: Tensor) -> Tensor:
    """Q_tot = sum of the robots' values (Sunehag et al. 2018). q: (M, n). Returns (M,)."""
    return q.sum(1)
