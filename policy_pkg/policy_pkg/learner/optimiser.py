"""One gradient step of nets: the loss' gradient, its norm clipped, torch's optimiser."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.nets import Nets
from policy_pkg.learner.replay import Batch
from policy_pkg.learner.torch_steps import Adam, RMSprop, UpdateRule

Array = npt.NDArray[Any]
_PREFIX = "optimiser."


class DivergedError(RuntimeError):
    """Loss or gradient is not finite. ``batch`` is a copy; the parameters are as before it."""

    def __init__(self, batch: Batch, loss: float, grad_norm: float, updates: int) -> None:
        super().__init__(
            f"update {updates + 1} diverged: loss {loss}, gradient norm {grad_norm}; "
            "the parameters were not changed"
        )
        self.batch = batch


class Optimiser:
    """torch's RMSprop or Adam over the nets' flat vector."""

    def __init__(self, config: LearnerConfig, nets: Nets) -> None:
        self._config, self._nets = config, nets
        self._flat = nets.flat.requires_grad_()
        self._flat.grad = nets.gradient
        self._optimiser = _make(config, self._flat)
        self.updates = 0

    def gradient(self, loss: Tensor) -> float:
        """Fills the nets' gradient; returns the loss."""
        with np.errstate(invalid="ignore", over="ignore"):  # told by ``step``
            self._nets.differentiate(loss)
        return loss.item()

    def step(self, loss: Tensor, batch: Batch) -> dict[str, float]:
        """Takes one step against the gradient; returns ``loss`` and ``grad_norm`` before clipping.

        Raises:
            DivergedError: loss or gradient is not finite.
        """
        value, clip = self.gradient(loss), self._config.grad_norm_clip
        norm = torch.linalg.vector_norm(self._nets.gradient).item()
        if not (math.isfinite(value) and math.isfinite(norm)):
            raise DivergedError(batch.copy(), value, norm, self.updates)
        if norm > clip:
            self._nets.gradient.mul_(clip / (norm + 1e-6))
        self._optimiser.step()
        self.updates += 1
        return {"loss": value, "grad_norm": norm}

    def state_dict(self) -> dict[str, Array]:
        """Copies, by name; nothing before the first step."""
        state = self._optimiser.state
        return {_PREFIX + name: tensor.cpu().numpy().copy() for name, tensor in state.items()}

    def load_state_dict(self, arrays: dict[str, Array], updates: int) -> None:
        """Puts back what ``state_dict`` gave after ``updates`` steps; ignores other arrays.

        Raises:
            ValueError: it belongs to another optimiser or other parameters.
        """
        moments = {k.removeprefix(_PREFIX): v for k, v in arrays.items() if k.startswith(_PREFIX)}
        size = self._flat.numel()
        expected = {} if updates == 0 else _moments(self._config, size)
        if {name: array.shape for name, array in moments.items()} != expected:
            raise ValueError(
                f"learner state's optimiser arrays {sorted(moments)} do not fit "
                f"{self._config.optimiser} over {size} parameters"
            )
        self._optimiser.state = {
            # the count of steps stays on the CPU, as torch has it
            name: torch.from_numpy(array.copy()).to("cpu" if array.ndim == 0 else self._flat.device)
            for name, array in moments.items()
        }
        self.updates = updates


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


def _make(config: LearnerConfig, flat: Tensor) -> UpdateRule:
    return (Adam if config.optimiser == "adam" else RMSprop)(config, flat)
