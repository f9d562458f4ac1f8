"""Benchmark rows of the learner: the gradient step against a plain padded one, and the replay.

Run alone: ``python -m benchmarks.bench_learner`` (env.sh sourced). Both learners take their
batches of the same episodes in turn, in one process and one thread; medians of CPU time, which
a busy machine disturbs less.
"""

from __future__ import annotations

import json
import statistics
import time
from typing import Any

import numpy as np
import torch

from benchmarks.bench_rollout import ARENAS, EPSILON, crashing_rollout
from benchmarks.numpy_learner.learner import NumpyLearner
from benchmarks.padded_learner import PaddedLearner, PaddedReplay
from policy_pkg.episode import Episode, Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import Learner
from policy_pkg.learner.replay import Replay

PLAYED = "skirmish/3s5z_vs_3s5z"  # as large as COMBAT
COMBAT = Sizes(n_robots=8, n_actions=14, obs_size=128, state_size=216, episode_limit=60)
BUTTONS = Sizes(n_robots=2, n_actions=5, obs_size=2, state_size=8, episode_limit=20)
BATCH_EPISODES = 32
STORED_EPISODES = 128

Row = dict[str, Any]


def random_episode(sizes: Sizes, rng: np.random.Generator, steps: int) -> Episode:
    """Random content, of available actions; the last step terminates."""
    n, actions = sizes.n_robots, sizes.n_actions
    available = rng.random((steps + 1, n, actions)) < 0.7
    available[..., 0] = True
    wanted = np.where(available[:-1], rng.random((steps, n, actions)), -1.0)
    return Episode(
        obs=rng.standard_normal((steps + 1, n, sizes.obs_size), dtype=np.float32),
        state=rng.standard_normal((steps + 1, sizes.state_size), dtype=np.float32),
        available=available,
        actions=wanted.argmax(axis=-1).astype(np.int32),
        reward=rng.standard_normal(steps, dtype=np.float32),
        faults=np.zeros((steps, n), np.uint8),
        terminated=True,
    )


def played_episodes() -> tuple[Sizes, list[Episode]]:
    """What an untrained team saw and did, half at random, crashed at rate 0.1."""
    rollout, sizes = crashing_rollout(PLAYED, ARENAS)
    episodes: list[Episode] = []
    while len(episodes) < STORED_EPISODES:
        episodes += [finished.episode for finished in rollout.step(EPSILON)]
    return sizes, episodes[:STORED_EPISODES]


def random_episodes(sizes: Sizes) -> tuple[Sizes, list[Episode]]:
    rng = np.random.default_rng(0)
    lengths = rng.integers(1, sizes.episode_limit + 1, STORED_EPISODES).tolist()
    return sizes, [random_episode(sizes, rng, steps) for steps in lengths]


def gradient_step_ms(sizes: Sizes, full_lengths: bool, repeats: int) -> tuple[float, float]:
    """Median times of (ours, padded), each with taking the batch from its replay, in turn."""
    rng = np.random.default_rng(0)
    limit = sizes.episode_limit
    # "real": lengths uniform up to the limit, so their mean is half of the maximum.
    lengths = rng.integers(limit if full_lengths else 1, limit + 1, STORED_EPISODES)
    episodes = [random_episode(sizes, rng, steps) for steps in lengths.tolist()]
    replay, padded_replay = Replay(STORED_EPISODES, sizes), PaddedReplay(sizes, episodes)
    for episode in episodes:
        replay.add(episode)
    learner, padded = Learner(LearnerConfig(), sizes, seed=0), PaddedLearner(sizes, seed=0)
    ours_s, padded_s = [], []
    for repeat in range(repeats + 2):
        slots = rng.choice(STORED_EPISODES, BATCH_EPISODES, replace=False)
        start = time.process_time()
        learner.update(replay.gather(slots), episodes=0)
        middle = time.process_time()
        padded.update(padded_replay, slots)
        end = time.process_time()
        if repeat >= 2:  # the first ones warm up
            ours_s.append(middle - start)
            padded_s.append(end - middle)
    return 1e3 * statistics.median(ours_s), 1e3 * statistics.median(padded_s)


def _row(name: str, ours_ms: float, reference_ms: float, target: float | None) -> Row:
    ratio = reference_ms / ours_ms
    return {
        "name": name,
        "value": round(ours_ms, 2),
        "unit": "ms",
        "reference": round(reference_ms, 2),
        "ratio": round(ratio, 2),
        "target": f">= {target}x" if target is not None else None,
        "ok": target is None or ratio >= target,
    }


def _step_row(name: str, sizes: Sizes, full_lengths: bool, target: float | None) -> Row:
    times = gradient_step_ms(sizes, full_lengths, 100 if sizes is BUTTONS else 25)
    return _row(name, *times, target)


def _numpy_row(name: str, content: tuple[Sizes, list[Episode]], target: float | None) -> Row:
    """The gradient step against the learner as it was in numpy, on the same batches in turn."""
    sizes, episodes = content
    rng = np.random.default_rng(0)
    replay, config = Replay(STORED_EPISODES, sizes), LearnerConfig()
    for episode in episodes:
        replay.add(episode)
    learner, before = Learner(config, sizes, seed=0), NumpyLearner(config, sizes, seed=0)
    ours_s, before_s = [], []
    for repeat in range(100 if sizes is BUTTONS else 25):
        batch = replay.gather(rng.choice(STORED_EPISODES, BATCH_EPISODES, replace=False))
        start = time.process_time()
        learner.update(batch, episodes=0)
        middle = time.process_time()
        before.update(batch)
        if repeat >= 2:
            ours_s.append(middle - start)
            before_s.append(time.process_time() - middle)
    ours, plain = (1e3 * statistics.median(seconds) for seconds in (ours_s, before_s))
    return _row(name, ours, plain, target)


def _replay_row() -> Row:
    """Bound of 5,000 combat episodes, against the sizes of its arrays by hand."""
    row_bytes = 8 * 128 * 4 + 216 * 4 + 8 * 14  # float32 observations and state, byte masks
    step_bytes = 8 * 4 + 4 + 8  # int32 actions, float32 reward, byte faults
    stated = 5000 * (61 * row_bytes + 60 * step_bytes + 18)
    bound = Replay(5000, COMBAT).nbytes_bound
    return {
        "name": "replay memory, 5000 episodes at most",
        "value": round(bound / 2**20),
        "unit": "MiB",
        "reference": round(stated / 2**20),
        "ratio": round(stated / bound, 2),
        "target": "<= reference",
        "ok": bound <= stated,
    }


def rows() -> list[Row]:
    """All rows: {name, value, unit, reference, ratio, target, ok}."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return [
            _step_row("gradient step, real length mix", COMBAT, False, 1.7),
            _step_row("gradient step, full lengths", COMBAT, True, 1.0),
            _step_row("gradient step, buttons", BUTTONS, False, None),
            _numpy_row("gradient step, to numpy's", played_episodes(), 1.5),
            _numpy_row("the same, of random numbers", random_episodes(COMBAT), None),
            _numpy_row("the same, buttons", random_episodes(BUTTONS), 1.0),
            _replay_row(),
        ]
    finally:
        torch.set_num_threads(threads)


if __name__ == "__main__":
    for row in rows():
        print(json.dumps(row))
