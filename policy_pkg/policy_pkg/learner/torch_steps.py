"""torch's RMSprop and Adam on one tensor, through the functions under torch.optim's classes.

The classes load all of torch's compiler, which takes longer than everything else that a training
loads. A test holds these against the classes, bit for bit.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor
from torch.optim.adam import adam
from torch.optim.rmsprop import rmsprop

from policy_pkg.learner.config import LearnerConfig

BETAS = (0.9, 0.999)  # Adam's


class UpdateRule(ABC):
    """Steps against ``tensor.grad``.

    ``state``: what is kept of earlier steps, by torch's names; empty before the first.
    """

    moments: tuple[str, ...]

    def __init__(self, config: LearnerConfig, tensor: Tensor) -> None:
        self._config, self._tensor = config, tensor
        self.state: dict[str, Tensor] = {}

    @torch.no_grad()
    def step(self) -> None:
        """Takes one step. The gradient has to be there."""
        gradient = self._tensor.grad
        assert gradient is not None
        if not self.state:
            self.state = {name: torch.zeros_like(self._tensor) for name in self.moments}
            self.state["step"] = torch.zeros(())  # torch keeps it on the CPU
        self._apply(gradient)

    @abstractmethod
    def _apply(self, gradient: Tensor) -> None: ...


class RMSprop(UpdateRule):
    moments = ("square_avg",)

    def _apply(self, gradient: Tensor) -> None:
        config, state = self._config, self.state
        rmsprop(
            [self._tensor], [gradient], [state["square_avg"]], [], [], [state["step"]],
            lr=config.lr, alpha=config.optim_alpha, eps=config.optim_eps,
            weight_decay=0.0, momentum=0.0, centered=False,
        )  # fmt: skip


class Adam(UpdateRule):
    moments = ("exp_avg", "exp_avg_sq")

    def _apply(self, gradient: Tensor) -> None:
        config, state = self._config, self.state
        adam(
            [self._tensor], [gradient], [state["exp_avg"]], [state["exp_avg_sq"]], [],
            [state["step"]],
            lr=config.lr, beta1=BETAS[0], beta2=BETAS[1], eps=config.optim_eps,
            weight_decay=0.0, amsgrad=False, maximize=False,
        )  # fmt: skip
