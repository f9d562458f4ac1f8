"""Benchmark rows of learning from recordings: gradient steps per second of each method.

Run alone: ``python -m benchmarks bench_offline``. All methods take their batches of the same
episodes in turn, in one process and one thread; medians of CPU time, which a busy machine disturbs
less. The reference is plain QMIX.
"""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np
import torch

from benchmarks.bench_learner import (
    BATCH_EPISODES,
    BUTTONS,
    COMBAT,
    STORED_EPISODES,
    random_episode,
)
from policy_pkg.episode import Sizes
from policy_pkg.learner.cloner import Cloner
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import Learner
from policy_pkg.learner.replay import Replay

WARM_UP = 2
LEAST_RATIO = 0.8  # of the conservative term: it shares the forward pass

Row = dict[str, Any]


def gradient_steps_per_s(sizes: Sizes, repeats: int) -> dict[str, float]:
    """Medians by method, each with taking the batch from the recordings."""
    rng = np.random.default_rng(0)
    recordings = Replay(STORED_EPISODES, sizes)
    for steps in rng.integers(1, sizes.episode_limit + 1, STORED_EPISODES).tolist():
        recordings.add(random_episode(sizes, rng, steps))
    learners: dict[str, Learner | Cloner] = {
        "plain QMIX": Learner(LearnerConfig(), sizes, seed=0),
        "conservative QMIX": Learner(LearnerConfig(conservative_weight=1.0), sizes, seed=0),
        "behaviour cloning": Cloner(LearnerConfig(), sizes, seed=0),
    }
    taken_s: dict[str, list[float]] = {name: [] for name in learners}
    for repeat in range(repeats + WARM_UP):
        slots = rng.choice(STORED_EPISODES, BATCH_EPISODES, replace=False)
        for name, learner in learners.items():
            start = time.process_time()
            batch = recordings.gather(slots)
            if isinstance(learner, Cloner):
                learner.update(batch)
            else:
                learner.update(batch, episodes=0)
            if repeat >= WARM_UP:
                taken_s[name].append(time.process_time() - start)
    return {name: 1 / statistics.median(times) for name, times in taken_s.items()}


def _rows(name: str, sizes: Sizes, repeats: int) -> list[Row]:
    speeds = gradient_steps_per_s(sizes, repeats)
    plain = speeds["plain QMIX"]
    rows: list[Row] = []
    for method, speed in speeds.items():
        target = LEAST_RATIO if method == "conservative QMIX" else None
        rows.append(
            {
                "name": f"offline, {name}: {method}",
                "value": round(speed, 1),
                "unit": "gradient steps/s",
                "reference": round(plain, 1),
                "ratio": round(speed / plain, 2),
                "target": None if target is None else f"ratio >= {target:g}",
                "ok": None if target is None else speed >= target * plain,
            }
        )
    return rows


def rows() -> list[Row]:
    """All rows: {name, value, unit, reference, ratio, target, ok}."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return [*_rows("buttons", BUTTONS, 60), *_rows("8 robots", COMBAT, 20)]
    finally:
        torch.set_num_threads(threads)
