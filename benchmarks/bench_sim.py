"""Environment steps per CPU second of the simulator alone: random available actions, one core.

python benchmarks/bench_sim.py
"""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np
from numba import njit

from sim_pkg.env import Env, make_env

SECONDS = 1.5
REPEATS = 3
WARM_UP_STEPS = 50
# Scenario, arenas, target. For buttons 20,000 steps/s with 32 arenas including acting are wanted,
# which needs about 40 % of it.
CASES: tuple[tuple[str, int, float | None], ...] = (
    ("buttons", 1, None),
    ("buttons", 32, 20_000 / 0.6),
    ("buttons", 64, None),
    ("skirmish/3s5z_vs_3s5z", 1, 5_000),
    ("skirmish/3s5z_vs_3s5z", 64, 25_000),
    ("skirmish/3s_vs_5z", 1, 5_000),
    ("skirmish/3s_vs_5z", 64, 45_000),
)


class _Play:
    """Random actions; an arena whose episode ends starts its next one at once."""

    def __init__(self, env: Env) -> None:
        self._env = env
        spec = env.spec
        rng = np.random.default_rng(0)
        shape = (256, env.n_arenas, spec.n_robots)
        self._numbers = rng.random(shape, dtype=np.float32)
        self._actions = np.zeros(shape[1:], dtype=np.int32)
        self._next_episode = env.n_arenas
        env.reset(np.arange(env.n_arenas), 0, np.arange(env.n_arenas))

    def steps(self, count: int) -> None:
        env = self._env
        for k in range(count):
            _choose(env.available, self._numbers[k % len(self._numbers)], self._actions)
            env.step(self._actions)
            ended = np.flatnonzero(~env.running)
            if ended.size:
                first = self._next_episode
                self._next_episode += ended.size
                env.reset(ended, 0, np.arange(first, self._next_episode))


@njit(cache=True)
def _choose(available, numbers, actions):  # type: ignore[no-untyped-def]
    """Of each robot's available actions one at random; numbers: (B, n) in 0..1."""
    for b in range(actions.shape[0]):
        for i in range(actions.shape[1]):
            left = int(numbers[b, i] * available[b, i].sum())
            for a in range(available.shape[2]):
                if available[b, i, a]:
                    if left == 0:
                        actions[b, i] = a
                        break
                    left -= 1


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
    """One row per scenario and batch size: {name, value, unit, reference, ratio, target, ok}.

    No reference: no other implementation of this scenario exists.
    """
    result = []
    for scenario, n_arenas, target in CASES:
        value = steps_per_s(scenario, n_arenas)
        result.append(
            {
                "name": f"sim {scenario.split('/')[-1]} {n_arenas} arena{'s' * (n_arenas > 1)}",
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
