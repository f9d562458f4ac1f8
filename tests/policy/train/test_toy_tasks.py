"""Small tasks that a working learner solves in seconds: a matrix game, and one with memory."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from policy_pkg.act import greedy
from policy_pkg.episode import Episode, Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import Learner
from policy_pkg.learner.replay import Replay
from policy_pkg.policy import RecurrentPolicy

FAST: dict[str, Any] = {
    "hidden": 32,
    "mixing_hidden": 8,
    "hypernet_hidden": 16,
    "optimiser": "adam",
    "lr": 3e-3,
    "target_update_interval_episodes": 20,
}


def _train(algorithm: str, sizes: Sizes, replay: Replay, updates: int) -> RecurrentPolicy:
    config = LearnerConfig.model_validate({**FAST, "algorithm": algorithm})
    learner, rng = Learner(config, sizes, seed=0), np.random.default_rng(0)
    for update in range(updates):
        learner.update(replay.sample(rng, min(32, len(replay))), episodes=update)
    return RecurrentPolicy(learner.agent_weights(), sizes.n_robots, sizes.n_actions)


@pytest.mark.parametrize("algorithm", ["qmix", "vdn", "iql"])
def test_matrix_game(algorithm: str) -> None:
    """The best joint action also is each robot's best on average; action 2 is forbidden."""
    payoff = np.array([[10.0, 2.0, 99.0], [2.0, 5.0, 99.0], [99.0, 99.0, 99.0]])
    sizes = Sizes(n_robots=2, n_actions=3, obs_size=1, state_size=1, episode_limit=1)
    available = np.array([[True, True, False]] * 2)
    replay = Replay(8, sizes)
    for actions in [*itertools.product((0, 1), repeat=2)] * 2:
        replay.add(
            Episode(
                obs=np.ones((2, 2, 1), np.float32),
                state=np.ones((2, 1), np.float32),
                available=np.stack((available, available)),
                actions=np.array([actions], np.int32),
                reward=np.array([payoff[actions]], np.float32),
                faults=np.zeros((1, 2), np.uint8),
                terminated=True,
            )
        )
    policy = _train(algorithm, sizes, replay, 300)
    q, _ = policy.forward(
        np.ones((2, 1), np.float32),
        np.full(2, -1, np.int32),
        np.arange(2, dtype=np.int32),
        policy.initial_hidden(2),
    )
    assert greedy(q, available).tolist() == [0, 0]


MEMORY = Sizes(n_robots=2, n_actions=2, obs_size=2, state_size=1, episode_limit=4)


def _memory_obs(cue: int) -> np.ndarray:
    """(5, n, 2): the cue (+-1) is seen at time 0 only; afterwards both cues look the same."""
    obs = np.zeros((5, 2, 2), np.float32)
    obs[0, :, 0] = 2 * cue - 1
    obs[3:, :, 1] = 1.0  # the moment of decision
    return obs


def _memory_replay() -> Replay:
    """Random actions; only the last ones matter: 1 for each robot that repeats the cue."""
    rng, replay = np.random.default_rng(0), Replay(256, MEMORY)
    for index in range(256):
        cue, actions = index % 2, rng.integers(0, 2, (4, 2), dtype=np.int32)
        reward = np.zeros(4, np.float32)
        reward[3] = np.count_nonzero(actions[3] == cue)
        replay.add(
            Episode(
                obs=_memory_obs(cue),
                state=np.zeros((5, 1), np.float32),
                available=np.ones((5, 2, 2), np.bool_),
                actions=actions,
                reward=reward,
                faults=np.zeros((4, 2), np.uint8),
                terminated=True,
            )
        )
    return replay


def _last_actions(policy: RecurrentPolicy, cue: int, keep_hidden: bool) -> list[int]:
    obs, hidden = _memory_obs(cue), policy.initial_hidden(2)
    robots, everything = np.arange(2, dtype=np.int32), np.ones((2, 2), np.bool_)
    for t in range(4):
        last = np.full(2, -1 if t == 0 else 0, np.int32)  # so that actions carry no memory
        q, hidden = policy.forward(obs[t], last, robots, hidden)
        if not keep_hidden:
            hidden = policy.initial_hidden(2)
    return [int(action) for action in greedy(q, everything)]


@pytest.mark.parametrize("algorithm", ["qmix", "vdn"])
def test_memory_task_is_solved_by_the_recurrent_state(algorithm: str) -> None:
    policy = _train(algorithm, MEMORY, _memory_replay(), 400)
    assert [_last_actions(policy, cue, keep_hidden=True) for cue in (0, 1)] == [[0, 0], [1, 1]]
    forgetful = [_last_actions(policy, cue, keep_hidden=False) for cue in (0, 1)]
    assert forgetful[0] == forgetful[1]
