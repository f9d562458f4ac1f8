"""The loss of QMIX, VDN, IQL and of any other mixer, in the order of its equation.

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
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from crash_coach_common.contract import stay_action
from policy_pkg.episode import Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.nets import Nets
from policy_pkg.learner.replay import Batch

Metrics = dict[str, Tensor]


@dataclass(frozen=True)
class Steps:
    """A ``Batch`` as tensors: N observation rows, M valid steps of B episodes, n robots."""

    inputs: Tensor  # (N * n, I)
    counts: Tensor  # (L+1,) int32 on the CPU, robots' rows at each time
    state: Tensor  # (N, S)
    now: Tensor  # (M,) the observation row at which each step begins
    taken: Tensor  # (M * n,) which of (N, n, A) values are those of the taken actions, row-major
    reward: Tensor  # (M,)
    bootstrap: Tensor  # (M,) 0 where the step terminated its episode, else 1
    available: Tensor  # (N, n, A)
    faults: Tensor  # (M, n) codes of the faults in force, 0: none
    weight: Tensor | None  # (M,) factor of each step's episode; None: 1
    alive: list[int]  # episodes that have an observation at t

    @classmethod
    def of(cls, batch: Batch, weights: Any, dtype: torch.dtype, device: str) -> Steps:
        """weights: (B,) factor of each of the batch's episodes in the loss; None: 1."""
        _, n, n_actions = batch.available.shape
        taken = (batch.now[:, np.newaxis] * n + np.arange(n)) * n_actions + batch.actions

        def tensor(array: Any, to: torch.dtype | None = None) -> Tensor:
            return torch.from_numpy(array).to(device, to)

        return cls(
            inputs=tensor(batch.inputs.reshape(-1, batch.inputs.shape[2]), dtype),
            counts=torch.from_numpy(batch.alive * n).int(),
            state=tensor(batch.state, dtype),
            now=tensor(batch.now),
            taken=tensor(taken.reshape(-1)),
            reward=tensor(batch.reward, dtype),
            bootstrap=tensor(batch.bootstrap, dtype),
            available=tensor(batch.available),
            faults=tensor(batch.faults),
            weight=None if weights is None else tensor(weights[batch.episode], dtype),
            alive=batch.alive.tolist(),
        )

    @property
    def faulted(self) -> Tensor:
        """(M, n)"""
        return self.faults != 0

    def values(self, nets: Nets) -> Tensor:
        """(N, n, A) action values of the observation rows."""
        return nets.agent(self.inputs, self.counts).view(self.available.shape)

    def at_taken(self, values: Tensor) -> Tensor:
        """(M, n) of (N, n, A) values those of the taken actions."""
        return values.reshape(-1).gather(0, self.taken).view(self.faults.shape)

    def after(self, rows: Tensor) -> Tensor:
        """Of (N, ...) what belongs to each step's end, (M, ...)."""
        return rows[self.alive[0] :]


def loss(
    config: LearnerConfig, sizes: Sizes, online: Nets, target: Nets, steps: Steps
) -> tuple[Tensor, Metrics]:
    """The loss, and means over what it counts: |TD error|, Q of the taken actions and target.

    They are of the team, for iql per robot; with a conservative_weight also the term conservative.
    """
    q = steps.values(online)
    q_taken = steps.at_taken(q)
    total = online.mix(q_taken, steps.state.index_select(0, steps.now))

    with torch.no_grad():
        q_target = steps.after(steps.values(target))
        following = next_values(config, sizes, steps, steps.after(q), q_target)
        following = target.mix(following, steps.after(steps.state))
        returns = lambda_returns(steps, following, config.gamma, config.td_lambda)

    error = returns - total
    count = error.numel()
    if config.crashed_loss == "drop":  # iql only: error is (M, n)
        keep = ~steps.faulted
        count = max(1, int(keep.sum()))
        error, total, returns = error * keep, total * keep, returns * keep
    squared = error.square()
    if steps.weight is not None:
        squared = squared * _per_step(steps.weight, squared)
    mean = squared.sum() / count
    metrics = {
        "td_error_abs": error.detach().abs().sum() / count,
        "q_taken_mean": total.detach().sum() / count,
        "target_mean": returns.sum() / count,
    }
    if config.conservative_weight > 0:
        term = cross_entropy(q, steps, keep_crashed=config.crashed_conservative == "keep")
        mean = mean + config.conservative_weight * term
        metrics["conservative"] = term.detach()
    return mean, metrics


def next_values(
    config: LearnerConfig, sizes: Sizes, steps: Steps, q_online: Tensor, q_target: Tensor
) -> Tensor:
    """(M, n) the target net's value of each robot's next action; inputs (M, n, A)."""
    available = steps.after(steps.available)
    chooser = q_online if config.double_q else q_target
    best = chooser.masked_fill(~available, -torch.inf).argmax(2, keepdim=True)
    values = q_target.gather(2, best).squeeze(2)
    if config.crashed_target == "max":
        return values
    if config.crashed_target == "mean":
        crashed = (q_target * available).sum(2) / available.sum(2).clamp(min=1)
    else:
        stay = stay_action(available.cpu().numpy(), sizes.stay_actions)
        index = torch.from_numpy(stay).to(q_target.device).unsqueeze(2)
        crashed = q_target.gather(2, index).squeeze(2)
    return torch.where(steps.faulted, crashed, values)


def lambda_returns(steps: Steps, following: Tensor, gamma: float, td_lambda: float) -> Tensor:
    """y of every step, shaped as ``following``: (M,) of the team, for iql (M, n).

    The steps at t are ``alive[t + 1]`` rows; row i of them is followed by row i of the next t,
    where there is one: the returns come from the last t backwards.
    """
    reward = _per_step(steps.reward, following)
    discount = gamma * _per_step(steps.bootstrap, following)
    if td_lambda == 0:
        return reward + discount * following
    counts = steps.alive[1:]
    parts = [size for now, later in pairwise([*counts, 0]) for size in (later, now - later)]
    goes_on = torch.tensor([1.0, 0.0] * len(counts), dtype=following.dtype)
    goes_on = goes_on.repeat_interleave(torch.tensor(parts)).to(following.device)
    weight = td_lambda * _per_step(goes_on, following)  # of y_t+1; 0 at the last t
    returns = reward + discount * (1 - weight) * following
    here, later = returns.split_with_sizes(parts)[::2], returns.split_with_sizes(counts)[1:]
    share = (discount * weight).split_with_sizes(parts)[::2]
    for t in range(len(later) - 1, -1, -1):
        here[t].addcmul_(share[t], later[t])
    return returns


def cross_entropy(q: Tensor, steps: Steps, keep_crashed: bool) -> Tensor:
    """Mean over robot-steps of how unlikely the recorded actions are to a softmax of Q.

        l(o, a) = logsumexp_{a' available} Q(o, a') - Q(o, a)

    It is the conservative term of CQL (Kumar et al. 2020, equation 4, the variant with the entropy
    regulariser), and the loss of behaviour cloning.

    q: (N, n, A). keep_crashed: whether robot-steps with a fault in force count.
    """
    allowed = q.masked_fill(~steps.available, -torch.inf)
    each = -steps.at_taken(torch.log_softmax(allowed, 2))
    count = each.numel()
    if not keep_crashed:
        count = max(1, int((~steps.faulted).sum()))
        each = each.masked_fill(steps.faulted, 0.0)
    if steps.weight is not None:
        each = each * _per_step(steps.weight, each)
    return each.sum() / count


def _per_step(x: Tensor, like: Tensor) -> Tensor:
    """(M,) so that it goes with ``like``, (M,) or (M, n)."""
    return x if like.ndim == 1 else x.unsqueeze(1)
