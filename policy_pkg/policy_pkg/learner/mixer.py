"""Mixers: the robots' action values to the team's, by the name that ``learner.algorithm`` has.

A mixer is a ``torch.nn.Module`` made from (sizes, config), a ``Sizes`` and a ``LearnerConfig``.
Its ``forward(values, state)`` turns (M, n) values of the robots and (M, S) states into (M,) values
of the team. It should not fall where a robot's value rises: each robot acts on its own value.
Another package adds one through the entry point group ``crash_coach.mixers``
(docs/adding_an_algorithm.md).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from crash_coach_common.contract import UserError
from crash_coach_common.plugins import Plugins
from policy_pkg.episode import Sizes
from policy_pkg.learner.config import MIXER_GROUP, LearnerConfig
from policy_pkg.learner.layers import Linear
from policy_pkg.learner.native.kernel import library
from policy_pkg.learner.native.qmix import qmix


class Vdn(nn.Module):
    """The sum of the robots' values (Sunehag et al. 2018)."""

    def __init__(self, sizes: Sizes, config: LearnerConfig) -> None:
        super().__init__()

    def forward(self, values: Tensor, state: Tensor) -> Tensor:
        return values.sum(1)


class Qmix(nn.Module):
    """Q_tot = ELU(q |W1(s)| + b1(s)) |W2(s)| + V(s) (Rashid et al. 2018, section 4.1)."""

    def __init__(self, sizes: Sizes, config: LearnerConfig) -> None:
        super().__init__()
        mixing, hypernet = config.mixing_hidden, config.hypernet_hidden
        # First layers of W1, W2 and V, and b1: they read the same state, in one product.
        self.parts = [hypernet, hypernet, mixing, mixing]
        self.state = Linear(sizes.state_size, sum(self.parts))
        self.w1 = Linear(hypernet, sizes.n_robots * mixing)
        self.w2 = Linear(hypernet, mixing)
        self.v = Linear(mixing, 1)

    def forward(self, values: Tensor, state: Tensor) -> Tensor:
        # A kernel does what stands below in a fraction of the time of so many small operations.
        kernels = library(values, state)
        if kernels is not None:
            layers = (self.state, self.w1, self.w2, self.v)
            return qmix(kernels, values, state, [p for x in layers for p in (x.weight, x.bias)])
        for_w1, for_w2, for_v, b1 = self.state(state).split(self.parts, 1)
        w1 = self.w1(torch.relu(for_w1)).abs().view(*values.shape, -1)
        w2 = self.w2(torch.relu(for_w2)).abs()
        v = self.v(torch.relu(for_v)).squeeze(1)
        inner = nn.functional.elu((values.unsqueeze(2) * w1).sum(1) + b1)
        return (inner * w2).sum(1) + v


def _check(name: str, loaded: Any) -> None:
    if not (isinstance(loaded, type) and issubclass(loaded, nn.Module)):
        raise ValueError(
            f"mixer {name} is {loaded!r}; must be a class derived from torch.nn.Module"
        )


MIXERS: Plugins[type[nn.Module]] = Plugins(MIXER_GROUP, {"qmix": Qmix, "vdn": Vdn}, _check)


def make_mixer(config: LearnerConfig, sizes: Sizes) -> nn.Module | None:
    """None for iql, which has no mixer.

    Raises:
        UserError: another package's mixer cannot be made.
    """
    if config.algorithm == "iql":
        return None
    kind = MIXERS[config.algorithm]
    try:
        return kind(sizes, config)
    except TypeError as error:
        raise UserError(
            f"mixer {config.algorithm} cannot be made from (sizes, config): {error}"
        ) from error
