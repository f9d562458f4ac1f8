"""Behaviour cloning: the agent net learns to take the recorded actions, by cross-entropy.

    loss = mean over robot-steps without a fault of
           logsumexp_{a' available} f(o, a') - f(o, a)

f are the net's outputs, from which acting takes the largest, as of action values. On a robot-step
without a fault the executed action is the one that its policy wanted; the others teach nothing.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from policy_pkg.episode import Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.loss import Steps, cross_entropy
from policy_pkg.learner.replay import Batch
from policy_pkg.learner.trained import Array, Arrays, Trained

ALGORITHM = "behaviour_cloning"


class Cloner(Trained):
    """Agent net and optimiser; see ``Trained``."""

    def __init__(
        self, config: LearnerConfig, sizes: Sizes, seed: int, dtype: npt.DTypeLike = np.float32
    ) -> None:
        super().__init__(config, sizes, seed, dtype, algorithm=ALGORITHM, mixing=False)

    def update(self, batch: Batch, *, weights: Array | None = None) -> dict[str, float]:
        """One gradient step.

        weights: (B,) factor of each of the batch's episodes in the loss; None: 1.
        Returns loss, grad_norm (before clipping), and agreement: the share of the counted
        robot-steps at which the greedy action is the recorded one.

        Raises:
            DivergedError: loss or gradient is not finite.
        """
        steps = self._steps(batch, weights)
        outputs = steps.values(self._online)
        agreement = _agreement(steps, outputs.detach())
        metrics = self._step(cross_entropy(outputs, steps, keep_crashed=False), batch)
        return {**metrics, "agreement": agreement}

    def loss_and_gradients(
        self, batch: Batch, weights: Array | None = None
    ) -> tuple[float, Arrays]:
        """Loss and its gradient by parameter name (copies); changes nothing."""
        steps = self._steps(batch, weights)
        outputs = steps.values(self._online)
        return self._gradients(cross_entropy(outputs, steps, keep_crashed=False))


def _agreement(steps: Steps, outputs: Tensor) -> float:
    greedy = outputs.masked_fill(~steps.available, -torch.inf).argmax(2)
    n_actions = outputs.shape[2]
    same = greedy.view(-1)[steps.taken // n_actions] == steps.taken % n_actions
    kept = ~steps.faulted
    return int((same.view(kept.shape) & kept).sum()) / max(1, int(kept.sum()))
