"""A gradient step of QMIX with double Q-learning, in numpy; gradients written out."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from benchmarks.numpy_learner import agent_net, mixer
from benchmarks.numpy_learner.optimiser import Optimiser
from benchmarks.numpy_learner.packed_gru import Schedule
from benchmarks.numpy_learner.parameters import FlatParameters, initial_values, part
from policy_pkg.episode import Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.replay import Batch

Array = npt.NDArray[Any]


class NumpyLearner:
    """Online and target nets and the optimiser, in float32."""

    def __init__(self, config: LearnerConfig, sizes: Sizes, seed: int) -> None:
        self.config, self.sizes = config, sizes
        parts = {
            "agent": agent_net.shapes(sizes, config.hidden),
            "mixer": mixer.qmix_shapes(sizes, config.mixing_hidden, config.hypernet_hidden),
        }
        shapes = {f"{net}.{k}": v for net, (named, _) in parts.items() for k, v in named.items()}
        fan_in = {f"{net}.{k}": v for net, (_, fans) in parts.items() for k, v in fans.items()}
        values = initial_values(shapes, fan_in, np.random.Generator(np.random.Philox(seed)))
        self._online = FlatParameters(shapes, values, np.float32)
        self._target = FlatParameters(shapes, values, np.float32)
        self._optimiser = Optimiser(config, self._online)

    def update(self, batch: Batch) -> None:
        """One gradient step."""
        self._gradient(batch)
        self._optimiser.step(self._optimiser.gradient_norm())

    def _gradient(self, batch: Batch) -> None:
        n, first = self.sizes.n_robots, int(batch.alive[0])
        agent, mix = (part(self._online.named, prefix) for prefix in ("agent.", "mixer."))
        target, target_mix = (part(self._target.named, prefix) for prefix in ("agent.", "mixer."))
        schedule = Schedule([int(rows) * n for rows in batch.alive])
        inputs = batch.inputs.reshape(-1, self.sizes.input_size)
        q, tape = agent_net.values_and_tape(agent, inputs, schedule)
        q_target = agent_net.values(target, inputs, schedule)
        rows = batch.now[:, np.newaxis] * n + np.arange(n)
        shape = (*rows.shape, self.sizes.n_actions)
        following = np.empty(rows.shape, np.float32)
        _best(
            q[first * n :].reshape(shape),
            q_target[first * n :].reshape(shape),
            batch.available_next,
            following,
        )
        value, mixed = mixer.qmix(mix, q[rows, batch.actions], batch.state[batch.now])
        following, _ = mixer.qmix(target_mix, following, batch.state[first:])
        error = batch.reward + self.config.gamma * batch.bootstrap * following - value
        gradients = part(self._online.named_gradients, "mixer.")
        grad_value = error * (-2.0 / error.size)
        grad_q = np.zeros_like(q)
        grad_q[rows, batch.actions] = mixer.qmix_gradients(mix, mixed, grad_value, gradients)
        agent_net.gradients(agent, tape, grad_q, part(self._online.named_gradients, "agent."))


@njit(cache=True)
def _best(chooser: Array, values: Array, available: Array, out: Array) -> None:
    """out = values at the available action of the highest ``chooser``; the first of equals."""
    steps, robots, actions = values.shape
    for m in range(steps):
        for robot in range(robots):
            best = -1
            for a in range(actions):
                if available[m, robot, a] and (
                    best < 0 or chooser[m, robot, a] > chooser[m, robot, best]
                ):
                    best = a
            out[m, robot] = values[m, robot, max(best, 0)]
