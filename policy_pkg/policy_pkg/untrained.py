"""A team with random weights: to try a graph, test it or time it before anything is trained."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from crash_coach_common.contract import EnvSpec
from policy_pkg.checkpoint import Manifest, write_checkpoint
from policy_pkg.policy import weight_shapes

SCALE = 0.3  # wide enough that the action depends on observation and memory


def write_untrained(folder: Path, spec: EnvSpec, seed: int, hidden: int = 64) -> None:
    """Writes a checkpoint of the scenario's sizes to ``folder``, the only one in its parent.

    Raises:
        OSError: it cannot be written.
    """
    rng = np.random.default_rng(seed)
    actions, inputs = spec.n_actions, spec.obs_size + spec.n_actions + spec.n_robots
    weights = {
        name: (SCALE * rng.standard_normal(shape)).astype(np.float32)
        for name, shape in weight_shapes(inputs, hidden, actions).items()
    }
    manifest = Manifest(
        scenario=spec.scenario,
        robots=spec.robots,
        n_actions=actions,
        obs_size=spec.obs_size,
        config={},
        progress={},
        training={},
    )
    write_checkpoint(folder, manifest, {"agent": weights}, keep_last=1)
