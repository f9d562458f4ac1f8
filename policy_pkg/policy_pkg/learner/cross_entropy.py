"""How unlikely recorded actions are to a policy that draws available actions by softmax of Q.

    l(o, a) = logsumexp_{a' available} Q(o, a') - Q(o, a)

It is the conservative term of CQL (Kumar et al. 2020, equation 4, the variant with the entropy
regulariser) for one robot-step, and the cross-entropy of behaviour cloning.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from policy_pkg.learner.replay import Batch

Array = npt.NDArray[Any]


def robot_step_weights(batch: Batch, keep_crashed: bool, episodes: Array | None) -> Array:
    """(M, n) float64 weights of a mean over robot-steps; their number is that of the kept ones.

    keep_crashed: whether robot-steps with a fault in force count.
    episodes: (B,) factor of each of the batch's episodes; None: 1.
    """
    keep = np.ones_like(batch.faults, np.bool_) if keep_crashed else batch.faults == 0
    weights: Array = keep / max(1, int(np.count_nonzero(keep)))
    return weights if episodes is None else weights * episodes[batch.episode][:, np.newaxis]


def cross_entropy(q: Array, batch: Batch, weights: Array, factor: float, grad_q: Array) -> float:
    """Sum of weights * l over the batch's robot-steps, with l at each step's beginning.

    Adds ``factor`` times its gradient to ``grad_q``.

    Args:
        q, grad_q: (N * n, A) of the packed observation rows.
        weights: (M, n); where it is 0 nothing is read.
    """
    value: float = _cross_entropy(
        q, batch.available, batch.actions, batch.now, weights, factor, grad_q
    )
    return value


@njit(cache=True)
def _cross_entropy(
    q: Array,
    available: Array,
    actions: Array,
    now: Array,
    weights: Array,
    factor: float,
    grad_q: Array,
) -> float:
    steps, robots = actions.shape
    n_actions = q.shape[1]
    total = 0.0
    for m in range(steps):
        for robot in range(robots):
            weight = weights[m, robot]
            if weight == 0.0:
                continue
            row, allowed = now[m] * robots + robot, available[now[m], robot]
            highest = -np.inf
            for a in range(n_actions):
                if allowed[a] and q[row, a] > highest:
                    highest = q[row, a]
            scale = 0.0
            for a in range(n_actions):
                if allowed[a]:
                    scale += math.exp(q[row, a] - highest)
            taken = actions[m, robot]
            total += weight * (highest + math.log(scale) - q[row, taken])
            share = factor * weight
            for a in range(n_actions):
                if allowed[a]:
                    grad_q[row, a] += share * (math.exp(q[row, a] - highest) / scale)
            grad_q[row, taken] -= share
    return total
