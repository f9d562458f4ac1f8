"""Agent net and mixer as one module over a flat vector, and how they begin.

Optimiser, gradient norm and target copy each work on the whole vector at once: with a dozen small
tensors, the calls would cost more than the arithmetic.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from policy_pkg.episode import Sizes
from policy_pkg.learner.agent_net import AgentNet
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.layers import Linear
from policy_pkg.learner.mixer import make_mixer

Array = npt.NDArray[Any]


class Nets(nn.Module):
    """``agent``, and ``mixer`` where the method has one; every parameter is a view of ``flat``.

    mixing: False for an agent net alone.
    """

    def __init__(self, config: LearnerConfig, sizes: Sizes, mixing: bool = True) -> None:
        super().__init__()
        self.agent = AgentNet(sizes, config.hidden)
        self.mixing = mixing
        self.mixer = make_mixer(config, sizes) if mixing else None
        self.flat = self.gradient = torch.empty(0)
        self._views: list[nn.Parameter] = []  # into ``flat``, in its order

    def flatten(self, like: Nets | None = None, **place: Any) -> None:
        """Lays the parameters out in one vector; with the values of ``like``, frozen, or their own.

        place: dtype and device.
        """
        self.to(**place)
        self._views = list(self.parameters())
        self.flat = torch.cat([p.detach().reshape(-1) for p in self._views])
        if like is not None:
            self.flat.copy_(like.flat)
        self.gradient = torch.zeros_like(self.flat)
        parts = self.flat.split_with_sizes([p.numel() for p in self._views])
        for parameter, part in zip(self._views, parts, strict=True):
            parameter.data = part.view(parameter.shape)
        self.requires_grad_(like is None)

    def differentiate(self, loss: Tensor) -> None:
        """Fills ``gradient``."""
        found = torch.autograd.grad(loss, self._views, materialize_grads=True)
        torch.cat([grad.reshape(-1) for grad in found], out=self.gradient)

    def mix(self, values: Tensor, state: Tensor) -> Tensor:
        """(M, n) values of the robots -> (M,) of the team; without a mixer as they are."""
        return values if self.mixer is None else self.mixer(values, state)

    def copy_(self, other: Nets) -> None:
        """Takes over the other's values."""
        self.flat.copy_(other.flat.detach())

    def named(self) -> Iterator[tuple[str, nn.Parameter]]:
        """Parameters by the names that checkpoints have; those of an agent net alone by its own."""
        return (self if self.mixing else self.agent).named_parameters()

    def arrays(self) -> dict[str, Array]:
        """The parameters by name; on the CPU they are views."""
        return {name: p.detach().cpu().numpy() for name, p in self.named()}

    def agent_arrays(self) -> dict[str, Array]:
        """Those of the agent net."""
        return {name: p.detach().cpu().numpy() for name, p in self.agent.named_parameters()}

    def gradients(self) -> dict[str, Array]:
        """The parameters' gradients by name; on the CPU they are views."""
        parts = self.gradient.split_with_sizes([p.numel() for p in self._views])
        by_parameter = dict(zip(self._views, parts, strict=True))
        return {k: by_parameter[p].view(p.shape).cpu().numpy() for k, p in self.named()}

    @torch.no_grad()
    def load_arrays(self, arrays: Mapping[str, Array]) -> None:
        """Puts values back by name; ignores other names."""
        for name, parameter in self.named():
            parameter.copy_(torch.from_numpy(arrays[name]))


def make_nets(
    config: LearnerConfig, sizes: Sizes, seed: int, mixing: bool = True, **place: Any
) -> Nets:
    """Nets that begin from ``seed``.

    Our own layers uniformly in +-1/sqrt(fan in), torch's default, from a generator of our own;
    what else a mixer has begins as its class says, torch's generator being seeded.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        nets = Nets(config, sizes, mixing).double()
    rng = np.random.Generator(np.random.Philox(seed))
    for module in nets.modules():
        if isinstance(module, Linear | nn.GRUCell):
            bound = 1.0 / np.sqrt(next(module.parameters()).shape[1])
            for parameter in module.parameters():
                values = rng.uniform(-bound, bound, tuple(parameter.shape))
                parameter.data = torch.from_numpy(values)
    nets.flatten(**place)
    return nets
