"""Benchmark rows of rollouts and whole training, per core: environment steps per CPU second.

CPU time of one single-threaded process, so that other work on the machine counts little. The
policy is untrained and explores, so episodes run to their limit.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.config import CoachConfig, TeamSpec
from policy_pkg.episode import Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import Learner
from policy_pkg.learner.replay import Replay
from policy_pkg.play.rollout import Rollout
from policy_pkg.policy import RecurrentPolicy
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.session import TrainSession
from sim_pkg.env import make_env
from sim_pkg.scenario_files import find_scenario

ARENAS = 32
EPSILON = 0.5
CRASH_RATE = 0.1
REPEATS = 5
ROLLOUT_TARGET = 20_000.0
TRAINING_TARGET = 4_000.0

Row = dict[str, Any]


def steps_per_cpu_s(work: Callable[[], None], env_steps: int) -> float:
    """Median over REPEATS; ``work`` makes ``env_steps``."""
    rates = []
    for _ in range(REPEATS):
        started_s = time.process_time()
        work()
        rates.append(env_steps / (time.process_time() - started_s))
    return float(np.median(rates))


def rollout_rate(scenario: str, arenas: int, calls: int) -> float:
    """Acting, exploring, crashing, stepping, and storing whole episodes in a replay."""
    env = make_env(scenario, arenas)
    spec, sizes = env.spec, Sizes.of(env.spec)
    weights = Learner(LearnerConfig.model_validate({}), sizes, seed=0).agent_weights()
    policy = RecurrentPolicy(weights, spec.n_robots, spec.n_actions)
    crash = CoachConfig.model_validate({"strategy": "fixed", "crash_rate": CRASH_RATE})
    coach = Coach(crash, TeamSpec.of(spec), seed=0)
    rollout = Rollout(env, policy, coach.plan, 0, np.random.default_rng(0))
    replay = Replay(500, sizes)

    def work() -> None:
        for _ in range(calls):
            for finished in rollout.step(EPSILON):
                replay.add(finished.episode)

    work()  # compiles
    return steps_per_cpu_s(work, arenas * calls)


def training_rate(scenario: str, calls: int) -> float:
    """Everything a run does but evaluation: 8 environments, 1/8 updates per episode."""
    config = TrainConfig.model_validate(
        {"scenario": scenario, "n_envs": 8, "updates_per_episode": 0.125, "replay_episodes": 500}
    )
    session = TrainSession(config, make_env(scenario, 8), make_env(scenario, 1))

    def work() -> None:
        for _ in range(calls):
            session.advance()

    while session.learner.updates < 3:
        session.advance()
    return steps_per_cpu_s(work, 8 * calls)


def longer(scenario: str, episode_limit: int, folder: Path) -> str:
    """The path of the same scenario with another episode limit."""
    lines = find_scenario(scenario).read_text().splitlines()
    changed = [
        f"episode_limit: {episode_limit}" if line.startswith("episode_limit:") else line
        for line in lines
    ]
    path = folder / f"{scenario}_{episode_limit}.yaml"
    path.write_text("\n".join(changed) + "\n")
    return str(path)


def row(name: str, value: float, target: float) -> Row:
    return {
        "name": name,
        "value": value,
        "unit": "environment steps/CPU s",
        "reference": None,
        "ratio": None,
        "target": target,
        "ok": value >= target,
    }


def rows() -> list[Row]:
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        eight = longer("buttons_8", 60, Path(folder))
        return [
            row(
                "rollout buttons 32 environments",
                rollout_rate("buttons", ARENAS, 400),
                ROLLOUT_TARGET,
            ),
            row(
                "training 8 robots, 8 environments, 1/8 updates per episode, T 60",
                training_rate(eight, 480),
                TRAINING_TARGET,
            ),
        ]


if __name__ == "__main__":
    print(json.dumps(rows(), indent=2))
