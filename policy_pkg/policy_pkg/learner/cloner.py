"""Behaviour cloning: the agent net learns to take the recorded actions, by cross-entropy.

    loss = mean over robot-steps without a fault of
           logsumexp_{a' available} f(o, a') - f(o, a)

f are the net's outputs, from which acting takes the largest, as of action values. On a robot-step
without a fault the executed action is the one that its policy wanted; the others teach nothing.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from policy_pkg.episode import Sizes
from policy_pkg.learner import agent_net
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.cross_entropy import cross_entropy, robot_step_weights
from policy_pkg.learner.flat_parameters import FlatParameters, initial_values, part
from policy_pkg.learner.learner import DivergedError
from policy_pkg.learner.optimiser import Optimiser, check_arrays
from policy_pkg.learner.packed_gru import Schedule
from policy_pkg.learner.replay import Batch

Array = npt.NDArray[Any]
Arrays = dict[str, Array]
Scalars = dict[str, int | str]
ALGORITHM = "behaviour_cloning"


class Cloner:
    """Agent net and optimiser. Deterministic: same seed, same batches, same bits."""

    def __init__(
        self, config: LearnerConfig, sizes: Sizes, seed: int, dtype: npt.DTypeLike = np.float32
    ) -> None:
        self.config, self.sizes, self.dtype = config, sizes, np.dtype(dtype)
        self.updates = 0
        shapes, fan_in = agent_net.shapes(sizes, config.hidden)
        values = initial_values(shapes, fan_in, np.random.Generator(np.random.Philox(seed)))
        self._net = FlatParameters(shapes, values, dtype)
        self._optimiser = Optimiser(config, self._net)

    def update(self, batch: Batch, *, weights: Array | None = None) -> dict[str, float]:
        """One gradient step.

        weights: (B,) factor of each of the batch's episodes in the loss; None: 1.
        Returns loss, grad_norm (before clipping), and agreement: the share of the counted
        robot-steps at which the greedy action is the recorded one.

        Raises:
            DivergedError: loss or gradient is not finite.
        """
        with np.errstate(invalid="ignore", over="ignore"):  # told by the check below
            metrics = self._gradient(batch, weights)
        norm = self._optimiser.gradient_norm()
        if not (math.isfinite(metrics["loss"]) and math.isfinite(norm)):
            raise DivergedError(batch.copy(), metrics["loss"], norm, self.updates)
        self._optimiser.step(norm)
        self.updates += 1
        return {**metrics, "grad_norm": norm}

    def loss_and_gradients(
        self, batch: Batch, weights: Array | None = None
    ) -> tuple[float, Arrays]:
        """Loss and its gradient by parameter name (copies); changes nothing."""
        loss = self._gradient(batch, weights)["loss"]
        return loss, {name: grad.copy() for name, grad in self._net.named_gradients.items()}

    def _gradient(self, batch: Batch, weights: Array | None) -> dict[str, float]:
        n = self.sizes.n_robots
        schedule = Schedule([int(rows) * n for rows in batch.alive])
        inputs = batch.inputs.astype(self.dtype, copy=False).reshape(-1, self.sizes.input_size)
        outputs, tape = agent_net.values_and_tape(self._net.named, inputs, schedule)
        grad = np.zeros_like(outputs)
        mean = robot_step_weights(batch, keep_crashed=False, episodes=weights)
        loss = cross_entropy(outputs, batch, mean, 1.0, grad)
        agent_net.gradients(self._net.named, tape, grad, self._net.named_gradients)
        return {"loss": loss, "agreement": self._agreement(batch, outputs)}

    def _agreement(self, batch: Batch, outputs: Array) -> float:
        shaped = outputs.reshape(batch.available.shape)[batch.now]
        greedy = np.where(batch.available[batch.now], shaped, -np.inf).argmax(2)
        kept = batch.faults == 0
        same = np.count_nonzero((greedy == batch.actions) & kept)
        return float(same) / max(1, int(np.count_nonzero(kept)))

    def agent_weights(self) -> Arrays:
        """The agent net by torch's names; views that follow every update."""
        return dict(self._net.named)

    def state_dict(self) -> tuple[Arrays, Scalars]:
        """Everything needed to go on bit for bit: arrays (copies) by name, and JSON scalars."""
        arrays = {name: array.copy() for name, array in self._arrays().items()}
        arrays.update(self._optimiser.state_dict())
        return arrays, {
            "algorithm": ALGORITHM,
            "optimiser": self.config.optimiser,
            "updates": self.updates,
        }

    def _arrays(self) -> Arrays:
        return {f"online.{name}": array for name, array in self._net.named.items()}

    def load_state_dict(self, arrays: Arrays, scalars: Scalars) -> None:
        """Puts back what ``state_dict`` gave.

        Raises:
            ValueError: it belongs to another method, optimiser or to other sizes.
        """
        for key, mine in (("algorithm", ALGORITHM), ("optimiser", self.config.optimiser)):
            if scalars.get(key) != mine:
                raise ValueError(f"learner state has {key} {scalars.get(key)}, this one {mine}")
        check_arrays(self._arrays(), arrays)
        self._optimiser.load_state_dict(arrays, int(scalars["updates"]))
        for name, array in part(arrays, "online.").items():
            self._net.named[name][...] = array
        self.updates = int(scalars["updates"])
