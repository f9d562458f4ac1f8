"""Weights of an agent net for tests, of no training."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from policy_pkg.policy import weight_shapes


def random_weights(
    inputs: int, hidden: int, actions: int, seed: int = 0
) -> dict[str, npt.NDArray[np.float32]]:
    """``inputs``: observation, last action's and robot's one-hots."""
    rng = np.random.default_rng(seed)
    shapes = weight_shapes(inputs, hidden, actions)
    return {
        name: (0.3 * rng.standard_normal(shape)).astype(np.float32)
        for name, shape in shapes.items()
    }
