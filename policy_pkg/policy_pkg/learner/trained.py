"""What everything that is trained has: nets on a device, their optimiser, and its state to save."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from crash_coach_common.contract import UserError
from policy_pkg.episode import Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.layers import DTYPES
from policy_pkg.learner.loss import Steps
from policy_pkg.learner.nets import Nets, make_nets
from policy_pkg.learner.optimiser import Optimiser, check_arrays
from policy_pkg.learner.replay import Batch

Array = npt.NDArray[Any]
Arrays = dict[str, Array]
Scalars = dict[str, int | str]


class Trained:
    """Base of ``Learner`` and ``Cloner``. On the CPU: same seed, same batches, same bits.

    dtype: float32 for training; float64 for checking gradients.
    """

    def __init__(
        self,
        config: LearnerConfig,
        sizes: Sizes,
        seed: int,
        dtype: npt.DTypeLike = np.float32,
        *,
        algorithm: str,
        mixing: bool,
    ) -> None:
        """Raises UserError: the device of ``learner.device`` is not there."""
        if config.device == "cuda" and not torch.cuda.is_available():
            raise UserError(
                "learner.device cuda: torch finds no GPU here "
                f"(torch {torch.__version__}, CUDA {torch.version.cuda}); use learner.device: cpu"
            )
        self.config, self.sizes, self.algorithm = config, sizes, algorithm
        self._place: dict[str, Any] = {
            "dtype": DTYPES[np.dtype(dtype).name],
            "device": config.device,
        }
        self._online = make_nets(config, sizes, seed, mixing, **self._place)
        self._optimiser = Optimiser(config, self._online)
        self._acting = self._online.agent_arrays()

    @property
    def updates(self) -> int:
        """Gradient steps so far."""
        return self._optimiser.updates

    def agent_weights(self) -> Arrays:
        """The online agent net by torch's names, on the CPU; they follow every update."""
        return dict(self._acting)

    def _steps(self, batch: Batch, weights: Array | None) -> Steps:
        return Steps.of(batch, weights, **self._place)

    def _step(self, loss: Tensor, batch: Batch) -> dict[str, float]:
        """One step against the loss' gradient; returns loss and grad_norm (before clipping).

        Raises:
            DivergedError: loss or gradient is not finite.
        """
        metrics = self._optimiser.step(loss, batch)
        self._follow()
        return metrics

    def _gradients(self, loss: Tensor) -> tuple[float, Arrays]:
        """Loss and its gradient by parameter name (copies)."""
        value = self._optimiser.gradient(loss)
        return value, {name: grad.copy() for name, grad in self._online.gradients().items()}

    def _follow(self) -> None:
        """``agent_weights`` are views of the nets, but copies of those on a GPU."""
        if self.config.device != "cpu":
            for name, array in self._online.agent_arrays().items():
                self._acting[name][...] = array

    def _nets(self) -> dict[str, Nets]:
        """What is saved, by prefix."""
        return {"online": self._online}

    def state_dict(self) -> tuple[Arrays, Scalars]:
        """Everything needed to go on bit for bit: arrays (copies) by name, and JSON scalars."""
        arrays = {name: array.copy() for name, array in self._arrays().items()}
        arrays.update(self._optimiser.state_dict())
        scalars: Scalars = {
            "algorithm": self.algorithm,
            "optimiser": self.config.optimiser,
            "updates": self.updates,
        }
        return arrays, scalars

    def _arrays(self) -> Arrays:
        return {
            f"{prefix}.{name}": array
            for prefix, nets in self._nets().items()
            for name, array in nets.arrays().items()
        }

    def load_state_dict(self, arrays: Arrays, scalars: Scalars) -> None:
        """Puts back what ``state_dict`` gave.

        Raises:
            ValueError: it belongs to another algorithm, optimiser or to other sizes.
        """
        for key, mine in (("algorithm", self.algorithm), ("optimiser", self.config.optimiser)):
            if scalars.get(key) != mine:
                raise ValueError(f"learner state has {key} {scalars.get(key)}, this learner {mine}")
        check_arrays(self._arrays(), arrays)
        self._optimiser.load_state_dict(arrays, int(scalars["updates"]))
        for prefix, nets in self._nets().items():
            nets.load_arrays({k.removeprefix(f"{prefix}."): v for k, v in arrays.items()})
        self._follow()
