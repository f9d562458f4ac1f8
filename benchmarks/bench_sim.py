"""Environment steps per CPU second of the simulator alone: random available actions, one core.

python benchmarks/bench_sim.py
"""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np

from sim_pkg.env import Env, make_env

SECONDS = 1.5
REPEATS = 3
WARM_UP_STEPS = 50
# Issue 3 wants 20,000 steps/s with 32 arenas including acting, which needs about 40 % of it.
TARGETS: dict[int, float | None] = {1: None, 32: 20_000 / 0.6, 64: None}


class _Play:
    """Random actions; an arena whose episode ends starts its next one at once."""

    def __init__(self, env: Env) -> None:
        self._env = env
        spec = env.spec
        rng = np.random.default_rng(0)
        shape = (256, env.n_arenas, spec.n_robots)
        self._actions = rng.integers(0, spec.n_actions, shape).astype(np.int32)
        self._next_episode = env.n_arenas
        env.reset(np.arange(env.n_arenas), 0, np.arange(env.n_arenas))

    def steps(self, count: int) -> None:
        env = self._env
        for k in range(count):
            env.step(self._actions[k % len(self._actions)])
            ended = np.flatnonzero(~env.running)
            if ended.size:
                first = self._next_episode
                self._next_episode += ended.size
                env.reset(ended, 0, np.arange(first, self._next_episode))


def steps_per_s(scenario: str, n_arenas: int) -> float:
    """The best of a few runs: other processes can only slow one down."""
    play = _Play(make_env(scenario, n_arenas))
    play.steps(WARM_UP_STEPS)
    chunk = max(1, 512 // n_arenas)
    best = 0.0
    for _ in range(REPEATS):
        start, done = time.process_time(), 0
        while (spent := time.process_time() - start) < SECONDS / REPEATS:
            play.steps(chunk)
            done += chunk * n_arenas
        best = max(best, done / spent)
    return best


def rows() -> list[dict[str, Any]]:
    """One row per batch size: {name, value, unit, reference, ratio, target, ok}.

    No reference: no other implementation of this scenario exists.
    """
    result = []
    for n_arenas, target in TARGETS.items():
        value = steps_per_s("buttons", n_arenas)
        result.append(
            {
                "name": f"sim buttons {n_arenas} arenas",
                "value": value,
                "unit": "steps/s",
                "reference": None,
                "ratio": None,
                "target": target,
                "ok": target is None or value >= target,
            }
        )
    return result


if __name__ == "__main__":
    print(json.dumps(rows(), indent=2))
