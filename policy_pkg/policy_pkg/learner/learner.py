"""The learner: one gradient step of QMIX, VDN, IQL or another mixer from a packed batch.

What is minimised stands in ``loss``. Thread counts are the process's business: start it with
OMP_NUM_THREADS=1 and OPENBLAS_NUM_THREADS=1 (a second thread gains nothing here), and on the CPU
the same seed gives the same bits. On a GPU it does not: its sums have no fixed order.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from policy_pkg.episode import Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.loss import loss
from policy_pkg.learner.nets import Nets
from policy_pkg.learner.optimiser import DivergedError
from policy_pkg.learner.replay import Batch
from policy_pkg.learner.trained import Array, Arrays, Scalars, Trained

__all__ = ["DivergedError", "Learner"]


class Learner(Trained):
    """Online and target nets and the optimiser; see ``Trained``."""

    def __init__(
        self, config: LearnerConfig, sizes: Sizes, seed: int, dtype: npt.DTypeLike = np.float32
    ) -> None:
        super().__init__(config, sizes, seed, dtype, algorithm=config.algorithm, mixing=True)
        self._target = Nets(config, sizes)
        self._target.flatten(like=self._online, **self._place)
        self._copied_at_episode = 0

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
        steps = self._steps(batch, weights)
        value, means = loss(self.config, self.sizes, self._online, self._target, steps)
        metrics = self._step(value, batch)
        if episodes - self._copied_at_episode >= self.config.target_update_interval_episodes:
            self._target.copy_(self._online)
            self._copied_at_episode = episodes
        return {**{name: mean.item() for name, mean in means.items()}, **metrics}

    def loss_and_gradients(
        self, batch: Batch, weights: Array | None = None
    ) -> tuple[float, Arrays]:
        """Loss and its gradient by parameter name (copies); changes nothing."""
        steps = self._steps(batch, weights)
        return self._gradients(loss(self.config, self.sizes, self._online, self._target, steps)[0])

    def _nets(self) -> dict[str, Nets]:
        return {"online": self._online, "target": self._target}

    def state_dict(self) -> tuple[Arrays, Scalars]:
        arrays, scalars = super().state_dict()
        return arrays, {**scalars, "copied_at_episode": self._copied_at_episode}

    def load_state_dict(self, arrays: Arrays, scalars: Scalars) -> None:
        super().load_state_dict(arrays, scalars)
        self._copied_at_episode = int(scalars["copied_at_episode"])
