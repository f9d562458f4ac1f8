"""The learner: one gradient step of QMIX, VDN or IQL from a packed batch of whole episodes.

    a*   = argmax_a Q(o', a; online), over the actions available at the step's end
    y    = r + gamma * (1 - terminated) * Q_tot(s', a*; target)
    loss = mean of (y - Q_tot(s, a))^2 over the valid steps, those with t < T

With td_lambda > 0, y is Peng's lambda-return (Peng and Williams 1996) over the stored episode, from
its end backwards and without cuts, V the target's value above:

    y_t = r_t + gamma * ((1 - lambda) * V(s_t+1) + lambda * y_t+1),  one-step at the last t

as in double Q-learning (van Hasselt et al. 2016) with QMIX's Q_tot; VDN's is the sum of the robots'
values (Sunehag et al. 2018); IQL has no mixer: each robot gets the team's reward and the mean runs
over steps and robots. On fixed data a conservative term is added, conservative_weight times

    mean over robot-steps of logsumexp_a Q(o, a; online) - Q(o, a_data; online)

that keeps actions which the data lack from being overvalued (CQL, Kumar et al. 2020).

The networks and their gradients are written out in numpy: at these sizes autograd's book-keeping
costs as much as the arithmetic. torch does the optimiser's step. Thread counts are the process's
business: start it with OMP_NUM_THREADS=1 and OPENBLAS_NUM_THREADS=1 (a second thread gains
nothing here), and the same seed gives the same bits.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from crash_coach_common.contract import stay_action
from policy_pkg.episode import Sizes
from policy_pkg.learner import agent_net, mixer
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.cross_entropy import cross_entropy, robot_step_weights
from policy_pkg.learner.flat_parameters import FlatParameters, Shapes, initial_values, part
from policy_pkg.learner.optimiser import Optimiser, check_arrays
from policy_pkg.learner.packed_gru import Schedule
from policy_pkg.learner.replay import Batch

Array = npt.NDArray[Any]
Arrays = dict[str, Array]
Scalars = dict[str, int | str]


class DivergedError(RuntimeError):
    """Loss or gradient is not finite. ``batch`` is a copy; the parameters are as before it."""

    def __init__(self, batch: Batch, loss: float, grad_norm: float, updates: int) -> None:
        super().__init__(
            f"update {updates + 1} diverged: loss {loss}, gradient norm {grad_norm}; "
            "the parameters were not changed"
        )
        self.batch = batch


class Learner:
    """Online and target nets and the optimiser. Deterministic: same seed, same batches, same bits.

    dtype: float32 for training; float64 for checking gradients.
    """

    def __init__(
        self,
        config: LearnerConfig,
        sizes: Sizes,
        seed: int,
        dtype: npt.DTypeLike = np.float32,
    ) -> None:
        self.config, self.sizes, self.dtype = config, sizes, np.dtype(dtype)
        self.updates = 0
        self._copied_at_episode = 0
        shapes, fan_in = _shapes(config, sizes)
        values = initial_values(shapes, fan_in, np.random.Generator(np.random.Philox(seed)))
        self._online = FlatParameters(shapes, values, dtype)
        self._target = FlatParameters(shapes, values, dtype)
        self._agent, self._mixer = _parts(self._online.named)
        self._target_agent, self._target_mixer = _parts(self._target.named)
        self._agent_gradients, self._mixer_gradients = _parts(self._online.named_gradients)
        self._optimiser = Optimiser(config, self._online)

    def update(
        self, batch: Batch, *, episodes: int, weights: Array | None = None
    ) -> dict[str, float]:
        """One gradient step; then the target copy when it is due.

        episodes: finished training episodes so far, which the target copies are counted in.
        weights: (B,) factor of each of the batch's episodes in the loss; None: 1.
        Returns loss, grad_norm (before clipping), and the means over valid steps of |TD error|,
        Q of the taken actions and target (of the team; for iql per robot); with a
        conservative_weight the term conservative, which the loss contains that many times.

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
        if episodes - self._copied_at_episode >= self.config.target_update_interval_episodes:
            self._target.flat[:] = self._online.flat
            self._copied_at_episode = episodes
        return {**metrics, "grad_norm": norm}

    def loss_and_gradients(
        self, batch: Batch, weights: Array | None = None
    ) -> tuple[float, Arrays]:
        """Loss and its gradient by parameter name (copies); changes nothing."""
        loss = self._gradient(batch, weights)["loss"]
        return loss, {name: grad.copy() for name, grad in self._online.named_gradients.items()}

    def _gradient(self, batch: Batch, weights: Array | None) -> dict[str, float]:
        """Fills the gradient of every parameter; returns loss and means."""
        n = self.sizes.n_robots
        first = int(batch.alive[0])
        schedule = Schedule([int(rows) * n for rows in batch.alive])
        inputs = self._cast(batch.inputs).reshape(-1, self.sizes.input_size)
        q, tape = agent_net.values_and_tape(self._agent, inputs, schedule)
        q_target = agent_net.values(self._target_agent, inputs, schedule)
        rows = batch.now[:, np.newaxis] * n + np.arange(n)
        shape = (*rows.shape, self.sizes.n_actions)
        taken = q[rows, batch.actions]
        following = self._next_values(
            batch, q[first * n :].reshape(shape), q_target[first * n :].reshape(shape)
        )
        if self.config.algorithm == "qmix":
            state = self._cast(batch.state)
            value, mixed = mixer.qmix(self._mixer, taken, state[batch.now])
            following, _ = mixer.qmix(self._target_mixer, following, state[first:])
            metrics, grad_value = self._error(batch, value, following, weights)
            grad_taken = mixer.qmix_gradients(self._mixer, mixed, grad_value, self._mixer_gradients)
        elif self.config.algorithm == "vdn":
            metrics, grad_value = self._error(batch, taken.sum(1), following.sum(1), weights)
            grad_taken = np.broadcast_to(grad_value[:, np.newaxis], taken.shape)
        else:
            metrics, grad_taken = self._error(batch, taken, following, weights)
        grad_q = np.zeros_like(q)
        grad_q[rows, batch.actions] = grad_taken
        if self.config.conservative_weight > 0:
            metrics |= self._conservative(batch, q, weights, metrics["loss"], grad_q)
        agent_net.gradients(self._agent, tape, grad_q, self._agent_gradients)
        return metrics

    def _conservative(
        self, batch: Batch, q: Array, weights: Array | None, loss: float, grad_q: Array
    ) -> dict[str, float]:
        """The conservative term and the ``loss`` with it; adds its gradient to ``grad_q``."""
        factor = self.config.conservative_weight
        mean = robot_step_weights(batch, self.config.crashed_conservative == "keep", weights)
        term = cross_entropy(q, batch, mean, factor, grad_q)
        return {"conservative": term, "loss": loss + factor * term}

    def _error(
        self, batch: Batch, value: Array, following: Array, weights: Array | None
    ) -> tuple[dict[str, float], Array]:
        """Loss and means, and the gradient of ``value``: (M,) of the team, for iql (M, n)."""
        steps = (-1,) + (1,) * (value.ndim - 1)
        target = self._targets(batch, following)
        assert target.shape == value.shape
        error, count = target - value, value.size
        if self.config.crashed_loss == "drop":
            keep = batch.faults == 0
            count = max(1, int(np.count_nonzero(keep)))
            error, value, target = error * keep, value * keep, target * keep
        metrics = {
            "td_error_abs": float(np.abs(error).sum()) / count,
            "q_taken_mean": float(value.sum()) / count,
            "target_mean": float(target.sum()) / count,
        }
        squared = np.square(error)
        if weights is not None:
            factor = self._cast(weights[batch.episode]).reshape(steps)
            squared, error = squared * factor, error * factor
        metrics["loss"] = float(squared.sum()) / count
        return metrics, error * (-2.0 / count)

    def _targets(self, batch: Batch, following: Array) -> Array:
        """y of every step, shaped as ``following``: (M,) of the team, for iql (M, n)."""
        reward, bootstrap = self._cast(batch.reward), self._cast(batch.bootstrap)
        gamma, td_lambda = self.config.gamma, self.config.td_lambda
        if td_lambda == 0:
            steps = (-1,) + (1,) * (following.ndim - 1)
            one_step: Array = reward.reshape(steps) + gamma * bootstrap.reshape(steps) * following
            return one_step
        flat = np.ascontiguousarray(following).reshape(len(reward), -1)
        out, weights = np.empty_like(flat), np.array([1 - td_lambda, td_lambda], self.dtype)
        _lambda_returns(reward, gamma * bootstrap, flat, batch.alive, weights, out)
        return out.reshape(following.shape)

    def _next_values(self, batch: Batch, q_online: Array, q_target: Array) -> Array:
        """(M, n) the target net's value of each robot's next action; inputs (M, n, A)."""
        available = batch.available_next
        values = np.empty(q_target.shape[:2], self.dtype)
        _best(q_online if self.config.double_q else q_target, q_target, available, values)
        if self.config.crashed_target == "max":
            return values
        if self.config.crashed_target == "mean":
            count = np.maximum(np.count_nonzero(available, axis=2), 1)
            crashed = (q_target * available).sum(2) / count
        else:
            stay = stay_action(available, self.sizes.stay_actions)
            crashed = np.take_along_axis(q_target, stay[:, :, np.newaxis], 2)[:, :, 0]
        return np.where(batch.faults != 0, crashed, values)

    def _cast(self, array: Array) -> Array:
        return array.astype(self.dtype, copy=False)

    def agent_weights(self) -> Arrays:
        """The online agent net by torch's names; views that follow every update."""
        return dict(self._agent)

    def state_dict(self) -> tuple[Arrays, Scalars]:
        """Everything needed to go on bit for bit: arrays (copies) by name, and JSON scalars."""
        arrays = {name: array.copy() for name, array in self._nets().items()}
        arrays.update(self._optimiser.state_dict())
        scalars: Scalars = {
            "algorithm": self.config.algorithm,
            "optimiser": self.config.optimiser,
            "updates": self.updates,
            "copied_at_episode": self._copied_at_episode,
        }
        return arrays, scalars

    def _nets(self) -> Arrays:
        return {
            f"{net}.{name}": array
            for net, params in (("online", self._online), ("target", self._target))
            for name, array in params.named.items()
        }

    def load_state_dict(self, arrays: Arrays, scalars: Scalars) -> None:
        """Puts back what ``state_dict`` gave.

        Raises:
            ValueError: it belongs to another algorithm, optimiser or to other sizes.
        """
        for key in ("algorithm", "optimiser"):
            if scalars.get(key) != getattr(self.config, key):
                raise ValueError(
                    f"learner state has {key} {scalars.get(key)}, "
                    f"this learner {getattr(self.config, key)}"
                )
        check_arrays(self._nets(), arrays)
        self._optimiser.load_state_dict(arrays, int(scalars["updates"]))
        for name, array in self._nets().items():
            array[...] = arrays[name]
        self.updates = int(scalars["updates"])
        self._copied_at_episode = int(scalars["copied_at_episode"])


def _parts(named: Arrays) -> tuple[Arrays, Arrays]:
    """Of the agent net and of the mixer."""
    return part(named, "agent."), part(named, "mixer.")


def _shapes(config: LearnerConfig, sizes: Sizes) -> tuple[Shapes, dict[str, int]]:
    parts = {"agent": agent_net.shapes(sizes, config.hidden)}
    if config.algorithm == "qmix":
        parts["mixer"] = mixer.qmix_shapes(sizes, config.mixing_hidden, config.hypernet_hidden)
    shapes = {f"{net}.{k}": v for net, (named, _) in parts.items() for k, v in named.items()}
    fan_in = {f"{net}.{k}": v for net, (_, fans) in parts.items() for k, v in fans.items()}
    return shapes, fan_in


@njit(cache=True)
def _lambda_returns(
    reward: Array,
    discount: Array,
    following: Array,
    alive: Array,
    weights: Array,
    out: Array,
) -> None:
    """out = lambda-returns of packed steps, (M, k) for (M,) rewards; see the module's text.

    weights: (2,) 1 - lambda and lambda. The steps at t are ``alive[t + 1]`` rows; row i of them is
    followed by row i of the next t, where there is one: the returns come from the last t backwards.
    """
    end, behind = out.shape[0], 0
    for t in range(alive.shape[0] - 1, 0, -1):
        begin = end - alive[t]
        for i in range(alive[t]):
            for k in range(out.shape[1]):
                value = following[begin + i, k]
                if i < behind:
                    value = weights[0] * value + weights[1] * out[end + i, k]
                out[begin + i, k] = reward[begin + i] + discount[begin + i] * value
        end, behind = begin, alive[t]


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
