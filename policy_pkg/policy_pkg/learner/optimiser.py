"""The optimiser's step on a flat parameter vector, with its gradient's norm clipped."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.flat_parameters import FlatParameters, part
from policy_pkg.learner.torch_steps import Adam, RMSprop, Steps

Array = npt.NDArray[Any]
_PREFIX = "optimiser."


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

    def state_dict(self) -> dict[str, Array]:
        """Copies, by name; nothing before the first step."""
        state = self._optimiser.state
        return {_PREFIX + name: tensor.numpy().copy() for name, tensor in state.items()}

    def load_state_dict(self, arrays: dict[str, Array], updates: int) -> None:
        """Puts back what ``state_dict`` gave after ``updates`` steps; ignores other arrays.

        Raises:
            ValueError: it belongs to another optimiser or other parameters.
        """
        moments, size = part(arrays, _PREFIX), self._parameters.flat.size
        expected = {} if updates == 0 else _moments(self._config, size)
        if {name: array.shape for name, array in moments.items()} != expected:
            raise ValueError(
                f"learner state's optimiser arrays {sorted(moments)} do not fit "
                f"{self._config.optimiser} over {size} parameters"
            )
        self._optimiser.state = {
            name: torch.from_numpy(array.copy()) for name, array in moments.items()
        }


def check_arrays(nets: dict[str, Array], arrays: dict[str, Array]) -> None:
    """Raises ValueError where a state's arrays lack one of ``nets``, or it does not fit."""
    for name, array in nets.items():
        given = arrays.get(name)
        if given is None or given.shape != array.shape or given.dtype != array.dtype:
            found = "nothing" if given is None else f"{given.dtype} {given.shape}"
            raise ValueError(f"learner state {name}: {found}; must be {array.dtype} {array.shape}")


def _moments(config: LearnerConfig, parameters: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the state that torch's optimiser keeps from its first step on."""
    names = ("exp_avg", "exp_avg_sq") if config.optimiser == "adam" else ("square_avg",)
    return {"step": (), **dict.fromkeys(names, (parameters,))}


def _make(config: LearnerConfig, flat: torch.Tensor) -> Steps:
    return (Adam if config.optimiser == "adam" else RMSprop)(config, flat)
