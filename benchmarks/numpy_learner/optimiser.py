"""The optimiser's step on a flat parameter vector, with its gradient's norm clipped."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from benchmarks.numpy_learner.parameters import FlatParameters
from policy_pkg.learner.config import LearnerConfig

Array = npt.NDArray[Any]


class Optimiser:
    """torch's RMSprop or Adam over ``parameters``, whose memory it shares."""

    def __init__(self, config: LearnerConfig, parameters: FlatParameters) -> None:
        self._config, self._parameters = config, parameters
        self._flat = torch.from_numpy(parameters.flat).requires_grad_()
        self._flat.grad = torch.from_numpy(parameters.gradient)
        self._optimiser = _make(config, self._flat)

    def gradient_norm(self) -> float:
        """Of all parameters' gradient together; inf or NaN where it is not finite."""
        gradient = self._parameters.gradient
        with np.errstate(invalid="ignore", over="ignore"):
            return math.sqrt(float(gradient @ gradient))

    def step(self, norm: float) -> None:
        """Scales the gradient of this ``norm`` down to the bound, and takes one step."""
        if norm > self._config.grad_norm_clip:
            self._parameters.gradient *= self._config.grad_norm_clip / (norm + 1e-6)
        self._optimiser.step()


def _make(config: LearnerConfig, flat: torch.Tensor) -> torch.optim.Optimizer:
    if config.optimiser == "adam":
        return torch.optim.Adam([flat], lr=config.lr, eps=config.optim_eps)
    return torch.optim.RMSprop([flat], lr=config.lr, alpha=config.optim_alpha, eps=config.optim_eps)
