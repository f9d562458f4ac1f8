"""Loss and every gradient against the slow reference, and how episodes share a batch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from reference_learner import Reference, loss, params_of, random_episode

from policy_pkg.episode import Episode, Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import Learner
from policy_pkg.learner.replay import Batch, Replay

SIZES = Sizes(
    n_robots=3, n_actions=4, obs_size=5, state_size=6, episode_limit=7, stay_actions=(2, 0)
)
SMALL: dict[str, Any] = {"hidden": 8, "mixing_hidden": 4, "hypernet_hidden": 6}


def _episodes(seed: int, crash_rate: float = 0.0) -> list[Episode]:
    """Mixed lengths with repeats, the shortest and the longest, terminated and truncated."""
    rng = np.random.default_rng(seed)
    lengths = [1, 1, SIZES.episode_limit, *rng.integers(1, SIZES.episode_limit + 1, 4).tolist()]
    return [
        random_episode(SIZES, rng, steps, terminated=i % 2 == 0, crash_rate=crash_rate)
        for i, steps in enumerate(lengths)
    ]


def _batch(episodes: list[Episode]) -> Batch:
    replay = Replay(len(episodes), SIZES)
    for episode in episodes:
        replay.add(episode)
    return replay.sample(np.random.default_rng(0), len(episodes))


def _learner(**settings: Any) -> Learner:
    """A float64 learner whose target nets differ from the online ones."""
    learner = Learner(LearnerConfig(**SMALL, **settings), SIZES, seed=3, dtype=np.float64)
    for seed in range(3):
        learner.update(_batch(_episodes(100 + seed)), episodes=0)
    return learner


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("settings", "reference"),
    [
        ({"algorithm": "qmix"}, Reference("qmix")),
        ({"algorithm": "vdn"}, Reference("vdn")),
        ({"algorithm": "iql"}, Reference("iql")),
        ({"algorithm": "qmix", "double_q": False}, Reference("qmix", double_q=False)),
        ({"algorithm": "vdn", "gamma": 0.7}, Reference("vdn", gamma=0.7)),
        ({"algorithm": "iql", "crashed_loss": "drop"}, Reference("iql", drop_crashed=True)),
        ({"algorithm": "qmix", "crashed_target": "mean"}, Reference("qmix", crashed_target="mean")),
        ({"algorithm": "vdn", "crashed_target": "stay"}, Reference("vdn", crashed_target="stay")),
        ({"algorithm": "qmix", "td_lambda": 0.8}, Reference("qmix", td_lambda=0.8)),
        ({"algorithm": "vdn", "td_lambda": 1.0}, Reference("vdn", td_lambda=1.0)),
        ({"algorithm": "iql", "td_lambda": 0.5}, Reference("iql", td_lambda=0.5)),
    ],
    ids=lambda value: "-".join(map(str, value.values())) if isinstance(value, dict) else "",
)
def test_loss_and_every_gradient_agree(
    settings: dict[str, Any], reference: Reference, seed: int
) -> None:
    episodes = _episodes(seed, crash_rate=0.5)
    learner = _learner(**settings)
    arrays, _ = learner.state_dict()
    online, target = params_of(arrays, "online", True), params_of(arrays, "target", False)
    assert any(not torch.equal(online[name], target[name]) for name in online)

    expected = loss(reference, SIZES, online, target, episodes)
    expected.backward()
    actual, gradients = learner.loss_and_gradients(_batch(episodes))

    assert actual == pytest.approx(expected.item(), rel=1e-6)
    assert gradients.keys() == online.keys()
    for name, param in online.items():
        assert param.grad is not None, name
        grad = param.grad.numpy()
        assert np.abs(grad).max() > 0, name
        # relative 1e-6 of each number; those that cancel to near nothing against the largest
        np.testing.assert_allclose(
            gradients[name], grad, rtol=1e-6, atol=1e-12 * np.abs(grad).max(), err_msg=name
        )


def test_a_lambda_return_of_one_is_the_discounted_sum_of_rewards() -> None:
    """lambda = 1 on terminated episodes reads nothing of the target nets."""
    rng = np.random.default_rng(8)
    batch = _batch([random_episode(SIZES, rng, steps, terminated=True) for steps in (1, 4, 7)])
    learner = _learner(algorithm="vdn", td_lambda=1.0)
    before, _ = learner.loss_and_gradients(batch)
    arrays, scalars = learner.state_dict()
    other = {k: v + 1 if k.startswith("target.") else v for k, v in arrays.items()}
    learner.load_state_dict(other, scalars)
    assert learner.loss_and_gradients(batch)[0] == before


def test_float32_gradients_are_those_of_float64() -> None:
    wide = _learner(algorithm="qmix")
    narrow = Learner(LearnerConfig(**SMALL), SIZES, seed=3)
    arrays, scalars = wide.state_dict()
    narrow.load_state_dict(
        {k: v if k == "optimiser.step" else v.astype(np.float32) for k, v in arrays.items()},
        scalars,
    )
    batch = _batch(_episodes(1))
    loss_wide, grads_wide = wide.loss_and_gradients(batch)
    loss_narrow, grads_narrow = narrow.loss_and_gradients(batch)
    assert loss_narrow == pytest.approx(loss_wide, rel=1e-5)
    for name, grad in grads_wide.items():
        np.testing.assert_allclose(
            grads_narrow[name], grad, rtol=1e-3, atol=1e-5 * np.abs(grad).max(), err_msg=name
        )


@pytest.mark.parametrize("algorithm", ["qmix", "vdn", "iql"])
def test_truncated_short_episode_leaves_the_others_alone(algorithm: str) -> None:
    """The summed error of a batch is the sum of its episodes' own, whatever their lengths."""
    rng = np.random.default_rng(5)
    long = [random_episode(SIZES, rng, SIZES.episode_limit, terminated=True) for _ in range(3)]
    short = random_episode(SIZES, rng, 2, terminated=False)
    learner = _learner(algorithm=algorithm)
    loss_long, grads_long = learner.loss_and_gradients(_batch(long))
    loss_short, grads_short = learner.loss_and_gradients(_batch([short]))
    loss_both, grads_both = learner.loss_and_gradients(_batch([*long, short]))
    steps = 3 * SIZES.episode_limit
    assert loss_both * (steps + 2) == pytest.approx(loss_long * steps + loss_short * 2, rel=1e-12)
    for name, grad in grads_both.items():
        expected = grads_long[name] * steps + grads_short[name] * 2
        np.testing.assert_allclose(
            grad * (steps + 2), expected, rtol=1e-9, atol=1e-12, err_msg=name
        )


def test_only_a_truncated_end_bootstraps() -> None:
    """gamma = 0 and gamma = 0.99 agree on a terminated one-step episode, not on a truncated one."""
    rng = np.random.default_rng(6)
    terminated = random_episode(SIZES, rng, 1, terminated=True)
    truncated = random_episode(SIZES, rng, 1, terminated=False)
    far, near = (_learner(algorithm="vdn", gamma=gamma) for gamma in (0.99, 0.0))
    near.load_state_dict(*far.state_dict())
    losses = [
        [learner.loss_and_gradients(_batch([e]))[0] for e in (terminated, truncated)]
        for learner in (far, near)
    ]
    assert losses[0][0] == losses[1][0]
    assert losses[0][1] != losses[1][1]


def test_nothing_behind_an_episodes_end_is_read() -> None:
    rng = np.random.default_rng(7)
    short = random_episode(SIZES, rng, 2, terminated=False)
    poison = random_episode(SIZES, rng, SIZES.episode_limit, terminated=True)
    poison.obs[:], poison.state[:], poison.reward[:] = np.nan, np.nan, np.nan
    replay = Replay(1, SIZES)
    replay.add(poison)
    replay.add(short)  # the same slot
    learner = _learner(algorithm="qmix")
    reused, _ = learner.loss_and_gradients(replay.sample(rng, 1))
    fresh, _ = learner.loss_and_gradients(_batch([short]))
    assert reused == fresh
