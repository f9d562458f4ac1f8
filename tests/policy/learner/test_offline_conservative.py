"""The conservative term: by hand, against autograd, and absent where its weight is 0."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from offline_recordings import SIZES, random_recordings
from reference_learner import Reference, loss, params_of, values
from torch import Tensor

from policy_pkg.episode import Episode, Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import Learner
from policy_pkg.learner.loss import Steps, cross_entropy
from policy_pkg.learner.replay import Batch, Replay

SMALL: dict[str, Any] = {"hidden": 8, "mixing_hidden": 4, "hypernet_hidden": 6}


def _episodes(seed: int, count: int = 6) -> list[Episode]:
    return [one.episode for one in random_recordings(count, seed, crash_rate=0.5)]


def _replay(episodes: list[Episode], sizes: Sizes = SIZES) -> Replay:
    replay = Replay(len(episodes), sizes)
    for episode in episodes:
        replay.add(episode)
    return replay


def _batch(episodes: list[Episode], sizes: Sizes = SIZES) -> Batch:
    return _replay(episodes, sizes).gather(np.arange(len(episodes)))


def _learner(**settings: Any) -> Learner:
    """A float64 learner whose target nets differ from the online ones."""
    learner = Learner(LearnerConfig(**SMALL, **settings), SIZES, seed=3, dtype=np.float64)
    for seed in range(3):
        learner.update(_batch(_episodes(100 + seed)), episodes=0)
    return learner


def _one_step() -> Batch:
    """Two robots, three actions of which the last is not available; the second robot crashed."""
    sizes = Sizes(n_robots=2, n_actions=3, obs_size=1, state_size=1, episode_limit=1)
    episode = Episode(
        obs=np.zeros((2, 2, 1), np.float32),
        state=np.zeros((2, 1), np.float32),
        # At the step's end everything is available, which must not matter.
        available=np.array([[[True, True, False]] * 2, [[True] * 3] * 2]),
        actions=np.array([[0, 1]], np.int32),
        reward=np.zeros(1, np.float32),
        faults=np.array([[0, 1]], np.uint8),
        terminated=True,
    )
    return _batch([episode], sizes)


def _cross_entropy(q: np.ndarray, keep_crashed: bool) -> tuple[float, np.ndarray]:
    """The term, and its gradient, of (rows, A) values of ``_one_step``."""
    values = torch.from_numpy(q).view(2, 2, 3).requires_grad_()
    steps = Steps.of(_one_step(), None, values.dtype, "cpu")
    term = cross_entropy(values, steps, keep_crashed)
    term.backward()
    assert values.grad is not None
    return term.item(), values.grad.view(4, 3).numpy()


def test_by_hand() -> None:
    """log(e^1 + e^2) - 1 = log(1 + e); its gradient is softmax(1, 2) minus the one-hot of 0."""
    q = np.array([[1.0, 2.0, 50.0], [3.0, 3.0, 0.0], [9.0] * 3, [9.0] * 3])
    term, grad = _cross_entropy(q, keep_crashed=False)
    assert term == pytest.approx(np.log(1 + np.e))
    share = 1 / (1 + np.e)  # softmax of the lower value
    expected = np.array([[share - 1, 1 - share, 0.0]])
    np.testing.assert_allclose(grad, np.concatenate((expected, np.zeros((3, 3)))))

    kept, grad = _cross_entropy(q, keep_crashed=True)
    assert kept == pytest.approx((np.log(1 + np.e) + np.log(2)) / 2)
    np.testing.assert_allclose(grad[1], [0.25, -0.25, 0.0])


def test_large_values_do_not_overflow() -> None:
    q = np.array([[1e5, -1e5, 1e9], [0.0] * 3, [0.0] * 3, [0.0] * 3], np.float32)
    term, grad = _cross_entropy(q, keep_crashed=False)
    assert term == 0.0
    assert np.isfinite(grad).all()


def _term(online: dict[str, Tensor], episodes: list[Episode], factors: Any, keep: bool) -> Tensor:
    total, count = torch.zeros((), dtype=torch.float64), 0
    for episode, factor in zip(episodes, factors, strict=True):
        q = values(online, episode)
        for t, robot in np.argwhere(np.full_like(episode.faults, keep) | (episode.faults == 0)):
            allowed = q[t][robot][torch.tensor(episode.available[t, robot])]
            taken = q[t][robot][int(episode.actions[t, robot])]
            total = total + factor * (torch.logsumexp(allowed, 0) - taken)
            count += 1
    return total / count


@pytest.mark.parametrize("weighted", [False, True], ids=["plain", "weighted"])
@pytest.mark.parametrize("crashed", ["drop", "keep"])
@pytest.mark.parametrize("algorithm", ["qmix", "vdn", "iql"])
def test_loss_and_every_gradient_agree_with_autograd(
    algorithm: str, crashed: str, weighted: bool
) -> None:
    episodes = sorted(_episodes(1), key=lambda episode: -episode.length)
    settings = {"conservative_weight": 0.7, "crashed_conservative": crashed}
    learner = _learner(algorithm=algorithm, **settings)
    arrays, _ = learner.state_dict()
    online, target = params_of(arrays, "online", True), params_of(arrays, "target", False)
    factors = np.linspace(0.5, 3.0, len(episodes)) if weighted else np.ones(len(episodes))
    steps = sum(episode.length for episode in episodes)
    td = sum(
        factor * episode.length * loss(Reference(algorithm), SIZES, online, target, [episode])
        for factor, episode in zip(factors, episodes, strict=True)
    )
    expected = td / steps + 0.7 * _term(online, episodes, factors, crashed == "keep")
    expected.backward()
    batch = _batch(episodes)
    actual, gradients = learner.loss_and_gradients(batch, factors if weighted else None)
    assert actual == pytest.approx(expected.item(), rel=1e-6)
    for name, param in online.items():
        assert param.grad is not None, name
        grad = param.grad.numpy()
        np.testing.assert_allclose(
            gradients[name], grad, rtol=1e-6, atol=1e-11 * np.abs(grad).max(), err_msg=name
        )


def test_weight_0_is_the_plain_learner_bit_for_bit() -> None:
    """A tiny weight changes bits, so that equality below says something."""
    states = []
    for weight in (None, 0.0, 1e-3):
        settings = {} if weight is None else {"conservative_weight": weight}
        learner = Learner(LearnerConfig(**SMALL, **settings), SIZES, seed=3)
        rng, replay = np.random.default_rng(0), _replay(_episodes(4, 20))
        metrics = [learner.update(replay.sample(rng, 8), episodes=80 * i) for i in range(6)]
        assert ("conservative" in metrics[0]) is (weight == 1e-3)
        states.append(learner.state_dict()[0])
    plain, zero, tiny = states
    assert all(np.array_equal(plain[name], zero[name]) for name in plain)
    assert any(not np.array_equal(plain[name], tiny[name]) for name in plain)


def test_weights_of_1_change_no_bit() -> None:
    learner, batch = _learner(conservative_weight=1.0), _batch(_episodes(2))
    plain, one = (learner.loss_and_gradients(batch, w) for w in (None, np.ones(6)))
    assert plain[0] == one[0]
    assert all(np.array_equal(plain[1][name], one[1][name]) for name in plain[1])


def test_a_batch_of_crashed_robots_only_has_no_term() -> None:
    (episode,) = _episodes(3, 1)
    episode.faults[:] = 1
    learner = Learner(LearnerConfig(**SMALL, conservative_weight=5.0), SIZES, seed=3)
    assert learner.update(_batch([episode]), episodes=0)["conservative"] == 0.0


def test_the_term_lowers_what_the_data_lack() -> None:
    """Same data, action 0 only: the gap between Q of action 0 and the others opens."""
    gaps = []
    for weight in (0.0, 1.0):
        learner = Learner(LearnerConfig(conservative_weight=weight), SIZES, seed=0)
        episodes = _episodes(5, 32)
        for episode in episodes:
            episode.available[:] = True
            episode.actions[:] = 0
        replay, rng = _replay(episodes), np.random.default_rng(0)
        for step in range(100):
            metrics = learner.update(replay.sample(rng, 16), episodes=step)
        if weight:
            gaps.append(metrics["conservative"])
        else:
            q_gap = Learner(LearnerConfig(conservative_weight=1e-9), SIZES, seed=0)
            q_gap.load_state_dict(*learner.state_dict())
            gaps.append(q_gap.update(replay.sample(rng, 16), episodes=0)["conservative"])
    plain, conservative = gaps
    assert conservative < 0.2 < plain


def test_steps_know_their_episode() -> None:
    episodes = _episodes(6, 9)
    batch = _batch(episodes)
    rewards = [batch.reward[batch.episode == i] for i in range(9)]
    for slot, reward in zip(batch.slots, rewards, strict=True):
        np.testing.assert_array_equal(reward, episodes[slot].reward)
    for i, slot in enumerate(batch.slots):
        available = batch.available[batch.now][batch.episode == i]
        np.testing.assert_array_equal(available, episodes[slot].available[:-1])
