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

from benchmarks.numpy_learner.learner import NumpyLearner
from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.team import TeamSpec
from policy_pkg.episode import Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import Learner
from policy_pkg.learner.replay import Batch, Replay
from policy_pkg.play.rollout import Rollout
from policy_pkg.policy import RecurrentPolicy
from policy_pkg.train.config import TrainConfig, load_train_config
from policy_pkg.train.session import TrainSession
from sim_pkg.env import make_env
from sim_pkg.scenario_files import find_scenario

ARENAS = 32
EPSILON = 0.5
CRASH_RATE = 0.1
REPEATS = 5
ROLLOUT_TARGET = 20_000.0
TRAINING_TARGET = 4_000.0
COMBAT = "skirmish/3s_vs_5z"
NUMPY_TARGET = 1.4

Row = dict[str, Any]


def steps_per_cpu_s(work: Callable[[], None], env_steps: int) -> float:
    """Median over REPEATS; ``work`` makes ``env_steps``."""
    rates = []
    for _ in range(REPEATS):
        started_s = time.process_time()
        work()
        rates.append(env_steps / (time.process_time() - started_s))
    return float(np.median(rates))


def crashing_rollout(scenario: str, arenas: int) -> tuple[Rollout, Sizes]:
    """Of an untrained team, each robot crashed with CRASH_RATE."""
    env = make_env(scenario, arenas)
    spec, sizes = env.spec, Sizes.of(env.spec)
    weights = Learner(LearnerConfig.model_validate({}), sizes, seed=0).agent_weights()
    policy = RecurrentPolicy(weights, spec.n_robots, spec.n_actions)
    crash = CoachConfig.model_validate({"strategy": "fixed", "crash_rate": CRASH_RATE})
    coach = Coach(crash, TeamSpec.of(spec), seed=0)
    return Rollout(env, policy, coach.plan, 0, np.random.default_rng(0)), sizes


def rollout_rate(scenario: str, arenas: int, calls: int) -> float:
    """Acting, exploring, crashing, stepping, and storing whole episodes in a replay."""
    rollout, sizes = crashing_rollout(scenario, arenas)
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


class _Both:
    """A session's learner, and beside it the one in numpy: the same batches, each timed."""

    def __init__(self, learner: Learner, config: TrainConfig) -> None:
        self._learner = learner
        self._numpy = NumpyLearner(config.learner, learner.sizes, config.seed)
        self.agent_weights = learner.agent_weights
        self.ours_s = self.numpy_s = 0.0

    @property
    def updates(self) -> int:
        return self._learner.updates

    def update(self, batch: Batch, **how: Any) -> dict[str, float]:
        started_s = time.process_time()
        metrics = self._learner.update(batch, **how)
        middle_s = time.process_time()
        self._numpy.update(batch)
        self.ours_s += middle_s - started_s
        self.numpy_s += time.process_time() - middle_s
        return metrics


def training_rates(scenario: str, updates: int) -> tuple[float, float]:
    """A whole training by skirmish/qmix, a gradient step per episode, from where batches begin:
    with our learner, and with the one in numpy in its place."""
    config = load_train_config("skirmish/qmix", [f"scenario={scenario}"])
    session = TrainSession(config, make_env(scenario, config.n_envs), make_env(scenario, 1))
    both = _Both(session.learner, config)
    session.learner = both  # type: ignore[assignment]
    while both.updates < 3:
        session.advance()
    both.ours_s = both.numpy_s = 0.0
    started_s, first, steps = time.process_time(), both.updates, session.steps
    while both.updates < first + updates:
        session.advance()
    spent_s, steps = time.process_time() - started_s, session.steps - steps
    return steps / (spent_s - both.numpy_s), steps / (spent_s - both.ours_s)


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
        ours, before = training_rates(COMBAT, 200)
        return [
            {
                **row(f"training {COMBAT}, and with the learner in numpy", ours, NUMPY_TARGET),
                "reference": before,
                "ratio": ours / before,
                "target": f">= {NUMPY_TARGET}x",
                "ok": ours / before >= NUMPY_TARGET,
            },
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
