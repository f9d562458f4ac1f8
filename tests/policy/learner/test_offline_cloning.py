"""Behaviour cloning: learns what un-faulted robots did, and nothing from the faulted ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from offline_recordings import SIZES, random_recordings
from reference_learner import params_of, values

from policy_pkg.act import greedy
from policy_pkg.episode import Episode, Sizes
from policy_pkg.learner.cloner import Cloner
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import DivergedError
from policy_pkg.learner.replay import Batch, Replay
from policy_pkg.policy import RecurrentPolicy

MEMORY = Sizes(n_robots=2, n_actions=3, obs_size=1, state_size=1, episode_limit=3)


def _batch(episodes: list[Episode]) -> Batch:
    replay = Replay(len(episodes), SIZES)
    for episode in episodes:
        replay.add(episode)
    return replay.gather(np.arange(len(episodes)))


def _episodes(seed: int) -> list[Episode]:
    return [one.episode for one in random_recordings(6, seed, crash_rate=0.5)]


def test_loss_and_every_gradient_agree_with_autograd() -> None:
    episodes = _episodes(1)
    cloner = Cloner(LearnerConfig(hidden=8), SIZES, seed=3, dtype=np.float64)
    arrays = {k.replace("online.", "online.agent."): v for k, v in cloner.state_dict()[0].items()}
    online = params_of(arrays, "online", True)
    total, count = torch.zeros((), dtype=torch.float64), 0
    for episode in episodes:
        q = values(online, episode)
        for t, robot in np.argwhere(episode.faults == 0):
            masked = q[t][robot][torch.tensor(episode.available[t, robot])]
            total = total + torch.logsumexp(masked, 0)
            total = total - q[t][robot][int(episode.actions[t, robot])]
            count += 1
    (total / count).backward()
    loss, gradients = cloner.loss_and_gradients(_batch(episodes))
    assert loss == pytest.approx((total / count).item(), rel=1e-9)
    for name, gradient in gradients.items():
        expected = online[f"agent.{name}"].grad
        assert expected is not None
        np.testing.assert_allclose(gradient, expected.numpy(), rtol=1e-6, atol=1e-12, err_msg=name)


def _memory_replay() -> Replay:
    """The cue (0 or 1) is seen at time 0; each robot takes it at time 2. Action 2 is forbidden.

    In every other episode robot_2 is crashed and does the opposite.
    """
    replay, rng = Replay(64, MEMORY), np.random.default_rng(0)
    available = np.ones((4, 2, 3), np.bool_)
    available[..., 2] = False
    for index in range(64):
        cue = index // 2 % 2
        obs = np.zeros((4, 2, 1), np.float32)
        obs[0] = 2 * cue - 1
        actions = np.zeros((3, 2), np.int32)
        actions[2] = cue
        faults = np.zeros((3, 2), np.uint8)
        if index % 2:
            actions[:, 1], faults[:, 1] = rng.integers(0, 2, 3), 1
            actions[2, 1] = 1 - cue
        replay.add(
            Episode(
                obs=obs,
                state=np.zeros((4, 1), np.float32),
                available=available,
                actions=actions,
                reward=np.zeros(3, np.float32),
                faults=faults,
                terminated=True,
            )
        )
    return replay


def test_a_task_with_memory_and_crashed_robots_is_cloned() -> None:
    config = LearnerConfig(hidden=16, optimiser="adam", lr=1e-2)
    cloner, replay, rng = Cloner(config, MEMORY, seed=0), _memory_replay(), np.random.default_rng(1)
    for _ in range(200):
        metrics = cloner.update(replay.sample(rng, 16))
    assert metrics["agreement"] == 1.0
    assert metrics["loss"] < 0.05
    policy = RecurrentPolicy(cloner.agent_weights(), 2, 3)
    allowed = np.array([[True, True, False]] * 2)
    for cue in (0, 1):
        hidden, last = policy.initial_hidden(2), np.full(2, -1, np.int32)
        for t in range(3):
            obs = np.full((2, 1), 2 * cue - 1 if t == 0 else 0, np.float32)
            q, hidden = policy.forward(obs, last, np.arange(2, dtype=np.int32), hidden)
            last = greedy(q, allowed)
        assert last.tolist() == [cue, cue]


@pytest.mark.parametrize("optimiser", ["rmsprop", "adam"])
def test_a_saved_cloner_goes_on_bit_for_bit(optimiser: Any) -> None:
    config = LearnerConfig(hidden=8, optimiser=optimiser)
    whole, half, other = (Cloner(config, SIZES, seed=s) for s in (1, 1, 2))
    for cloner in (whole, half):
        cloner.update(_batch(_episodes(1)))
    other.load_state_dict(*half.state_dict())
    for cloner in (whole, other):
        cloner.update(_batch(_episodes(2)))
    (mine, values_), (theirs, other_values) = whole.state_dict(), other.state_dict()
    assert values_ == other_values
    assert mine.keys() == theirs.keys()
    assert all(np.array_equal(mine[name], theirs[name]) for name in mine)


def test_states_that_do_not_fit_are_named() -> None:
    cloner = Cloner(LearnerConfig(hidden=8), SIZES, seed=1)
    arrays, scalars = cloner.state_dict()
    with pytest.raises(ValueError, match="has algorithm qmix, this learner behaviour_cloning"):
        cloner.load_state_dict(arrays, {**scalars, "algorithm": "qmix"})
    with pytest.raises(ValueError, match=r"fc1\.weight: float32 \(8, 12\); must be"):
        Cloner(LearnerConfig(hidden=9), SIZES, seed=1).load_state_dict(arrays, scalars)


def test_divergence_leaves_the_parameters() -> None:
    cloner = Cloner(LearnerConfig(hidden=8), SIZES, seed=1)
    episodes = _episodes(1)
    episodes[0].obs[:] = np.inf
    before = cloner.state_dict()[0]
    with pytest.raises(DivergedError, match="update 1 diverged"):
        cloner.update(_batch(episodes))
    assert all(np.array_equal(array, before[k]) for k, array in cloner.state_dict()[0].items())
