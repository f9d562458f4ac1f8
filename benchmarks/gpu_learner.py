"""The learner on a GPU beside the CPU: gradient steps, and gradients against float64.

Run by benchmarks/gpu.sh. Combat's sizes, real length mix; medians of wall time, the GPU's with
moving the batch there.
"""

from __future__ import annotations

import statistics
import sys
import time

import numpy as np
import torch

from benchmarks.bench_learner import COMBAT, random_episode
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import Learner
from policy_pkg.learner.replay import Batch, Replay

STORED_EPISODES = 256
REPEATS = 20


def step_ms(learner: Learner, batch: Batch) -> float:
    """Median of one gradient step; its figures are read back, so nothing is left to be computed."""
    times = []
    for repeat in range(REPEATS + 3):
        start = time.perf_counter()
        learner.update(batch, episodes=0)
        if repeat >= 3:  # the first ones warm up
            times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def worst(batch: Batch) -> float:
    """The GPU's largest error in a gradient, relative to the largest of its parameter."""
    _, expected = Learner(LearnerConfig(), COMBAT, 0, np.float64).loss_and_gradients(batch)
    _, found = Learner(LearnerConfig(device="cuda"), COMBAT, 0).loss_and_gradients(batch)
    return max(
        float(np.abs(found[name] - grad).max() / np.abs(grad).max())
        for name, grad in expected.items()
    )


def main() -> int:
    if not torch.cuda.is_available():
        print(f"torch {torch.__version__} finds no GPU here", file=sys.stderr)
        return 1
    torch.set_num_threads(1)
    print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}")
    rng = np.random.default_rng(0)
    replay = Replay(STORED_EPISODES, COMBAT)
    for steps in rng.integers(1, COMBAT.episode_limit + 1, STORED_EPISODES).tolist():
        replay.add(random_episode(COMBAT, rng, steps))
    for episodes in (32, 256):
        batch = replay.gather(rng.choice(STORED_EPISODES, episodes, replace=False)).copy()
        cpu = step_ms(Learner(LearnerConfig(), COMBAT, 0), batch)
        gpu = step_ms(Learner(LearnerConfig(device="cuda"), COMBAT, 0), batch)
        print(
            f"{episodes} episodes: CPU {cpu:.1f} ms, GPU {gpu:.1f} ms, {cpu / gpu:.2f} times as "
            f"fast; gradients within {worst(batch):.1e} of float64"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
