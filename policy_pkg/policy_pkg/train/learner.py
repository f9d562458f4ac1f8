"""The learner: one gradient step of QMIX, VDN or IQL from a packed batch of whole episodes.

    a*   = argmax_a Q(o', a; online), over the actions available at the step's end
    y    = r + gamma * (1 - terminated) * Q_tot(s', a*; target)
    loss = mean of (y - Q_tot(s, a))^2 over the valid steps, those with t < T

as in double Q-learning (van Hasselt et al. 2016) with QMIX's Q_tot; IQL has no mixer: each robot
gets the team's reward and the mean runs over steps and robots. Thread counts are the process's
business: start it with OMP_NUM_THREADS=1 and OPENBLAS_NUM_THREADS=1 (a second thread gains
nothing here), and the same seed gives the same bits.
"""

from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from policy_pkg.train import agent_net, mixer
from policy_pkg.train.episode import Sizes
from policy_pkg.train.learner_config import LearnerConfig
from policy_pkg.train.packed_gru import Schedule
from policy_pkg.train.parameters import FlatParameters, initial_values
from policy_pkg.train.replay import Batch

Arrays = dict[str, npt.NDArray[Any]]
Scalars = dict[str, int | str]
T = TypeVar("T")


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
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.config, self.sizes, self.dtype = config, sizes, dtype
        self.updates = 0
        self._copied_at_episode = 0
        shapes, fan_in = _shapes(config, sizes)
        values = initial_values(shapes, fan_in, np.random.Generator(np.random.Philox(seed)))
        self._online = FlatParameters(shapes, values, dtype)
        self._target = FlatParameters(shapes, values, dtype)
        self._parts = {
            (net, part): _part(params.named, part)
            for net, params in (("online", self._online), ("target", self._target))
            for part in ("agent", "mixer")
        }
        self._optimiser = _optimiser(config, self._online.flat)
        self._robot_offset = torch.arange(sizes.n_robots) * sizes.n_actions

    def update(self, batch: Batch, *, episodes: int) -> dict[str, float]:
        """One gradient step; then the target copy when it is due.

        episodes: finished training episodes so far, which the target copies are counted in.
        Returns loss, grad_norm (before clipping), and the means over valid steps of |TD error|,
        Q of the taken actions and target (of the team; for iql per robot).

        Raises:
            DivergedError: loss or gradient is not finite.
        """
        loss, means = self._loss(batch)
        loss_value, td_abs, q_taken, target = torch.stack((loss.detach(), *means)).tolist()
        norm = math.nan
        if math.isfinite(loss_value):
            grad = self._backward(loss)
            norm = float(torch.linalg.vector_norm(grad))
        if not math.isfinite(norm):
            raise DivergedError(batch.copy(), loss_value, norm, self.updates)
        if norm > self.config.grad_norm_clip:
            grad.mul_(self.config.grad_norm_clip / (norm + 1e-6))
        self._optimiser.step()
        self.updates += 1
        if episodes - self._copied_at_episode >= self.config.target_update_interval_episodes:
            self._target.flat.detach().copy_(self._online.flat.detach())
            self._copied_at_episode = episodes
        return {
            "loss": loss_value,
            "grad_norm": norm,
            "td_error_abs": td_abs,
            "q_taken_mean": q_taken,
            "target_mean": target,
        }

    def loss_and_gradients(self, batch: Batch) -> tuple[float, Arrays]:
        """Loss and its gradient by parameter name (copies); changes nothing."""
        loss, _ = self._loss(batch)
        self._backward(loss)
        grads = {
            name: tensor.grad.numpy().copy()
            for name, tensor in self._online.named.items()
            if tensor.grad is not None
        }
        return float(loss.detach()), grads

    def _backward(self, loss: Tensor) -> Tensor:
        """The gradient of all parameters, flat; its memory is that of ``flat.grad``."""
        grad = self._online.gradient
        grad.zero_()
        loss.backward()  # type: ignore[no-untyped-call]
        return grad

    def _loss(self, batch: Batch) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
        """The loss, and the means of |TD error|, taken value and target."""
        n = self.sizes.n_robots
        now, actions = torch.from_numpy(batch.now), torch.from_numpy(batch.actions)
        first = int(batch.alive[0])
        schedule = Schedule([int(rows) * n for rows in batch.alive])
        inputs = self._tensor(batch.inputs).view(-1, self.sizes.input_size)
        q_target = agent_net.unroll_values(self._parts["target", "agent"], inputs, schedule)
        q = agent_net.unroll(self._parts["online", "agent"], inputs, schedule)
        taken_index = (now * (n * self.sizes.n_actions)).unsqueeze(1) + actions + self._robot_offset
        taken = q.view(-1).gather(0, taken_index.view(-1)).view(-1, n)
        q_online = q.detach()
        with torch.no_grad():
            shape = (len(now), n, self.sizes.n_actions)
            following = self._next_values(
                batch, q_online[first * n :].view(shape), q_target[first * n :].view(shape)
            )
        reward, bootstrap = self._tensor(batch.reward), self._tensor(batch.bootstrap)
        keep: Tensor | None = None
        if self.config.algorithm == "iql":
            reward, bootstrap = reward.unsqueeze(1), bootstrap.unsqueeze(1)
            if self.config.crashed_loss == "drop":
                keep = torch.from_numpy(batch.faults).eq(0).to(self.dtype)
        else:
            state = self._tensor(batch.state)
            taken = self._mix("online", taken, state.index_select(0, now))
            with torch.no_grad():
                following = self._mix("target", following, state[first:])
        target = torch.addcmul(reward, bootstrap, following, value=self.config.gamma)
        error = target - taken
        means = tuple(_mean(x, keep) for x in (error.detach().abs(), taken.detach(), target))
        return _mean(error.square(), keep), (means[0], means[1], means[2])

    def _next_values(self, batch: Batch, q_online: Tensor, q_target: Tensor) -> Tensor:
        """(M, n) the target net's value of each robot's next action; inputs (M, n, A)."""
        available = torch.from_numpy(batch.available_next)
        chooser = q_online if self.config.double_q else q_target
        best = chooser.masked_fill(~available, -math.inf).argmax(2, keepdim=True)
        values = q_target.gather(2, best).squeeze(2)
        if self.config.crashed_target == "max":
            return values
        if self.config.crashed_target == "mean":
            weight = available.to(self.dtype)
            crashed = (q_target * weight).sum(2) / weight.sum(2).clamp(min=1)
        else:
            stays = torch.tensor(self.sizes.stay_actions)
            index = available[:, :, stays].to(torch.uint8).argmax(2)
            crashed = q_target.gather(2, stays[index].unsqueeze(2)).squeeze(2)
        return torch.where(torch.from_numpy(batch.faults) != 0, crashed, values)

    def _mix(self, net: str, q: Tensor, state: Tensor) -> Tensor:
        if self.config.algorithm == "vdn":
            return mixer.vdn(q)
        return mixer.qmix(self._parts[net, "mixer"], q, state)

    def _tensor(self, array: npt.NDArray[np.float32]) -> Tensor:
        return torch.from_numpy(array).to(self.dtype)

    def agent_weights(self) -> Arrays:
        """The online agent net by torch's names; views that follow every update."""
        return self._online.arrays("agent.")

    def state_dict(self) -> tuple[Arrays, Scalars]:
        """Everything needed to go on bit for bit: arrays (copies) by name, and JSON scalars."""
        arrays: Arrays = {}
        for net, params in (("online", self._online), ("target", self._target)):
            arrays.update({f"{net}.{k}": v.copy() for k, v in params.arrays().items()})
        state = self._optimiser.state[self._online.flat]
        arrays.update({f"optimiser.{k}": v.numpy().copy() for k, v in state.items()})
        scalars: Scalars = {
            "algorithm": self.config.algorithm,
            "optimiser": self.config.optimiser,
            "updates": self.updates,
            "copied_at_episode": self._copied_at_episode,
        }
        return arrays, scalars

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
        current: Arrays = {}
        for net, params in (("online", self._online), ("target", self._target)):
            current.update({f"{net}.{k}": v for k, v in params.arrays().items()})
        for name, array in current.items():
            given = arrays.get(name)
            if given is None or given.shape != array.shape or given.dtype != array.dtype:
                found = "nothing" if given is None else f"{given.dtype} {given.shape}"
                raise ValueError(
                    f"learner state {name}: {found}; must be {array.dtype} {array.shape}"
                )
        moments = _part(arrays, "optimiser")
        expected = {} if scalars["updates"] == 0 else _moments(self.config, len(self._online.flat))
        if {name: array.shape for name, array in moments.items()} != expected:
            raise ValueError(
                f"learner state's optimiser arrays {sorted(moments)} do not fit "
                f"{self.config.optimiser} over {len(self._online.flat)} parameters"
            )
        for name, array in current.items():
            array[...] = arrays[name]
        self._optimiser.state[self._online.flat] = {
            name: torch.from_numpy(array.copy()) for name, array in moments.items()
        }
        self.updates = int(scalars["updates"])
        self._copied_at_episode = int(scalars["copied_at_episode"])


def _mean(values: Tensor, keep: Tensor | None) -> Tensor:
    """Mean of all values, or of those that ``keep`` (1 or 0) marks; 0 if it marks none."""
    if keep is None:
        return values.mean()
    return (values * keep).sum() / keep.sum().clamp(min=1)


def _part(named: dict[str, T], part: str) -> dict[str, T]:
    prefix = f"{part}."
    return {k.removeprefix(prefix): v for k, v in named.items() if k.startswith(prefix)}


def _shapes(
    config: LearnerConfig, sizes: Sizes
) -> tuple[dict[str, tuple[int, ...]], dict[str, int]]:
    parts = {"agent": agent_net.shapes(sizes, config.hidden)}
    if config.algorithm == "qmix":
        parts["mixer"] = mixer.qmix_shapes(sizes, config.mixing_hidden, config.hypernet_hidden)
    shapes = {f"{part}.{k}": v for part, (named, _) in parts.items() for k, v in named.items()}
    fan_in = {f"{part}.{k}": v for part, (_, fans) in parts.items() for k, v in fans.items()}
    return shapes, fan_in


def _moments(config: LearnerConfig, parameters: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the state that torch's optimiser keeps from its first step on."""
    names = ("exp_avg", "exp_avg_sq") if config.optimiser == "adam" else ("square_avg",)
    return {"step": (), **dict.fromkeys(names, (parameters,))}


def _optimiser(config: LearnerConfig, flat: Tensor) -> torch.optim.Optimizer:
    if config.optimiser == "adam":
        return torch.optim.Adam([flat], lr=config.lr, eps=config.optim_eps)
    return torch.optim.RMSprop([flat], lr=config.lr, alpha=config.optim_alpha, eps=config.optim_eps)
