"""The two-step game of the QMIX paper (Rashid et al. 2018, section 5.1).

The first robot's first action leads to state 2A, where every joint action pays 7, or to 2B, whose
payoffs are [[0, 1], [1, 8]]. A sum of the robots' values cannot represent the 8.
"""

from __future__ import annotations

import itertools

import numpy as np
from reference_learner import mix, params_of, values

from policy_pkg.act import greedy
from policy_pkg.episode import Episode, Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import Learner
from policy_pkg.learner.replay import Replay
from policy_pkg.policy import RecurrentPolicy

SIZES = Sizes(n_robots=2, n_actions=2, obs_size=3, state_size=3, episode_limit=2)
PAYOFF_2B = np.array([[0.0, 1.0], [1.0, 8.0]])


def _episode(first: tuple[int, int], second: tuple[int, int]) -> Episode:
    middle = 1 + first[0]
    state = np.eye(3, dtype=np.float32)[[0, middle, middle]]
    payoff = 7.0 if middle == 1 else PAYOFF_2B[second]
    return Episode(
        obs=np.repeat(state[:, None], 2, axis=1),
        state=state,
        available=np.ones((3, 2, 2), np.bool_),
        actions=np.array([first, second], np.int32),
        reward=np.array([0.0, payoff], np.float32),
        faults=np.zeros((2, 2), np.uint8),
        terminated=True,
    )


def trained(algorithm: str) -> Learner:
    """Learns from uniform exploration: every joint action sequence equally often."""
    replay = Replay(32, SIZES)
    for a, b, c, d in [*itertools.product((0, 1), repeat=4)] * 2:
        replay.add(_episode((a, b), (c, d)))
    config = LearnerConfig.model_validate(
        {
            "algorithm": algorithm,
            "hidden": 32,
            "mixing_hidden": 8,
            "hypernet_hidden": 16,
            "optimiser": "adam",
            "lr": 3e-3,
            "target_update_interval_episodes": 50,
            "gamma": 1.0,
        }
    )
    learner, rng = Learner(config, SIZES, seed=0), np.random.default_rng(0)
    for update in range(700):
        learner.update(replay.sample(rng, 32), episodes=update)
    return learner


def greedy_episode(learner: Learner) -> Episode:
    """What the greedy joint policy does."""
    policy = RecurrentPolicy(learner.agent_weights(), 2, 2)
    hidden, last = policy.initial_hidden(2), np.full(2, -1, np.int32)
    robots, everything = np.arange(2, dtype=np.int32), np.ones((2, 2), np.bool_)
    state, chosen = 0, []
    for _ in range(2):
        obs = np.repeat(np.eye(3, dtype=np.float32)[[state]], 2, axis=0)
        q, hidden = policy.forward(obs, last, robots, hidden)
        last = greedy(q, everything)
        chosen.append((int(last[0]), int(last[1])))
        state = 1 + chosen[0][0]
    return _episode(chosen[0], chosen[1])


def _greedy_return(learner: Learner) -> tuple[float, float]:
    """(return, Q_tot at the start) of the greedy joint policy."""
    episode = greedy_episode(learner)
    params = params_of(learner.state_dict()[0], "online", False)
    q_start = values(params, episode)[0]
    taken = [q_start[robot][int(episode.actions[0, robot])] for robot in range(2)]
    total = mix(learner.config.algorithm, params, taken, episode.state[0])
    return float(episode.reward.sum()), float(total)


def test_qmix_learns_the_value_8() -> None:
    payoff, value = _greedy_return(trained("qmix"))
    assert payoff == 8.0
    assert abs(value - 8.0) < 0.1


def test_vdn_settles_at_7() -> None:
    payoff, value = _greedy_return(trained("vdn"))
    assert payoff == 7.0
    assert abs(value - 7.0) < 0.1
