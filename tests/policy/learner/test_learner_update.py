"""What an update does beside the gradient: optimiser, clipping, target copies, state, errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from reference_learner import random_episode

from policy_pkg.episode import Sizes
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import DivergedError, Learner
from policy_pkg.learner.replay import Batch, Replay

SIZES = Sizes(n_robots=2, n_actions=3, obs_size=4, state_size=5, episode_limit=6)
SMALL: dict[str, Any] = {"hidden": 8, "mixing_hidden": 4, "hypernet_hidden": 6}


def _replay(seed: int = 0, count: int = 20) -> Replay:
    rng = np.random.default_rng(seed)
    replay = Replay(count, SIZES)
    for i in range(count):
        steps = int(rng.integers(1, SIZES.episode_limit + 1))
        replay.add(random_episode(SIZES, rng, steps, terminated=bool(i % 2)))
    return replay


def _learner(**settings: Any) -> Learner:
    return Learner(LearnerConfig(**{**SMALL, **settings}), SIZES, seed=1)


def _net(learner: Learner, net: str) -> dict[str, np.ndarray]:
    arrays, _ = learner.state_dict()
    return {k.removeprefix(net): v for k, v in arrays.items() if k.startswith(net)}


def _same(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    return a.keys() == b.keys() and all(a[k].tobytes() == b[k].tobytes() for k in a)


@pytest.mark.parametrize(("clip", "clipped"), [(1e6, False), (0.01, True)])
def test_rmsprop_step_is_the_formula(clip: float, clipped: bool) -> None:
    """torch.optim.RMSprop: v = alpha v + (1 - alpha) g^2; p -= lr g / (sqrt(v) + eps)."""
    learner, replay = _learner(grad_norm_clip=clip), _replay()
    batch = replay.sample(np.random.default_rng(0), 8)
    before = _net(learner, "online.")
    _, grads = learner.loss_and_gradients(batch)
    norm = np.sqrt(sum(float((g.astype(np.float64) ** 2).sum()) for g in grads.values()))
    metrics = learner.update(batch, episodes=0)
    assert metrics["grad_norm"] == pytest.approx(norm, rel=1e-5)
    assert clipped == (norm > clip)
    scale = clip / norm if clipped else 1.0
    for name, after in _net(learner, "online.").items():
        g = grads[name].astype(np.float64) * scale
        expected = before[name] - 5e-4 * g / (np.sqrt(0.01 * g**2) + 1e-5)
        np.testing.assert_allclose(after, expected, rtol=1e-4, atol=2e-7, err_msg=name)


def test_adam_first_step_moves_by_lr_against_the_gradient() -> None:
    learner, replay = _learner(optimiser="adam", optim_eps=1e-12), _replay()
    batch = replay.sample(np.random.default_rng(0), 8)
    before = _net(learner, "online.")
    _, grads = learner.loss_and_gradients(batch)
    learner.update(batch, episodes=0)
    for name, after in _net(learner, "online.").items():
        expected = before[name] - 5e-4 * np.sign(grads[name])
        np.testing.assert_allclose(after, expected, atol=1e-6, err_msg=name)


def test_target_nets_are_copied_every_200_episodes() -> None:
    learner, replay, rng = _learner(), _replay(), np.random.default_rng(0)
    start = _net(learner, "online.")
    for episodes in (1, 100, 199):
        learner.update(replay.sample(rng, 4), episodes=episodes)
        assert _same(_net(learner, "target."), start)
    learner.update(replay.sample(rng, 4), episodes=203)
    copied = _net(learner, "online.")
    assert _same(_net(learner, "target."), copied)
    for episodes in (204, 402):  # counted from 203, the copy
        learner.update(replay.sample(rng, 4), episodes=episodes)
        assert _same(_net(learner, "target."), copied)
    learner.update(replay.sample(rng, 4), episodes=403)
    assert _same(_net(learner, "target."), _net(learner, "online."))


@pytest.mark.parametrize("optimiser", ["rmsprop", "adam"])
@pytest.mark.parametrize("algorithm", ["qmix", "vdn", "iql"])
def test_saved_and_loaded_goes_on_bit_for_bit(algorithm: str, optimiser: str) -> None:
    settings: dict[str, Any] = {
        "algorithm": algorithm,
        "optimiser": optimiser,
        "target_update_interval_episodes": 3,
    }

    def run(learner: Learner, replay: Replay, rng: np.random.Generator, span: range) -> list[Any]:
        return [learner.update(replay.sample(rng, 8), episodes=i) for i in span]

    whole, replay = _learner(**settings), _replay()
    expected = run(whole, replay, np.random.default_rng(4), range(10))

    rng = np.random.default_rng(4)
    first = _learner(**settings)
    metrics = run(first, replay, rng, range(5))
    arrays, scalars = first.state_dict()
    stored = replay.state_dict()
    run(first, replay, np.random.default_rng(9), range(5, 8))  # must not reach into the state
    second = Learner(LearnerConfig(**SMALL, **settings), SIZES, seed=77)
    second.load_state_dict(arrays, scalars)
    restored = Replay(20, SIZES)
    restored.load_state_dict(stored)
    metrics += run(second, restored, rng, range(5, 10))
    assert metrics == expected
    assert _same(second.state_dict()[0], whole.state_dict()[0])
    assert second.state_dict()[1] == whole.state_dict()[1]


def test_fresh_learner_saves_and_loads() -> None:
    arrays, scalars = _learner().state_dict()
    other = Learner(LearnerConfig(**SMALL), SIZES, seed=8)
    other.load_state_dict(arrays, scalars)
    assert _same(other.state_dict()[0], arrays)


def test_same_seed_same_bits_other_seed_other_weights() -> None:
    a, b = _learner(), _learner()
    assert _same(_net(a, "online."), _net(b, "online."))
    c = Learner(LearnerConfig(**SMALL), SIZES, seed=2)
    assert not _same(_net(a, "online."), _net(c, "online."))


def test_agent_weights_follow_updates_without_a_copy() -> None:
    learner = _learner()
    weights = learner.agent_weights()
    assert weights["fc1.weight"].shape == (8, SIZES.obs_size + SIZES.n_actions + SIZES.n_robots)
    before = weights["fc2.bias"].copy()
    learner.update(_replay().sample(np.random.default_rng(0), 8), episodes=0)
    assert not np.array_equal(before, weights["fc2.bias"])
    assert np.array_equal(weights["fc2.bias"], learner.agent_weights()["fc2.bias"])


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_divergence_stops_with_the_batch_and_unchanged_parameters(value: float) -> None:
    learner, rng = _learner(), np.random.default_rng(0)
    replay = Replay(4, SIZES)
    for _ in range(4):
        episode = random_episode(SIZES, rng, 3, terminated=True)
        episode.reward[1] = value
        replay.add(episode)
    before, _ = learner.state_dict()
    with pytest.raises(DivergedError, match=r"update 1 diverged: loss (nan|inf)") as caught:
        learner.update(replay.sample(rng, 4), episodes=0)
    saved: Batch = caught.value.batch
    replay.sample(rng, 1)  # the replay's buffers move on, the saved batch does not
    assert np.count_nonzero(~np.isfinite(saved.reward)) == 4
    assert set(saved.arrays()) >= {"inputs", "state", "actions", "reward", "slots"}
    assert _same(learner.state_dict()[0], before)


def test_foreign_state_is_refused_and_nothing_changes() -> None:
    learner = _learner()
    before, scalars = learner.state_dict()
    with pytest.raises(ValueError, match="algorithm vdn, this learner qmix"):
        learner.load_state_dict(*_learner(algorithm="vdn").state_dict())
    with pytest.raises(ValueError, match=r"online\.agent\.fc1\.weight: float32 \(4, 9\)"):
        learner.load_state_dict(*_learner(hidden=4).state_dict())
    with pytest.raises(ValueError, match="optimiser"):
        learner.load_state_dict(
            {**before} | {"optimiser.square_avg": np.zeros(3, np.float32)},
            scalars,
        )
    assert _same(learner.state_dict()[0], before)


def test_config_refuses_what_makes_no_sense() -> None:
    with pytest.raises(ValidationError, match="crashed_loss=drop needs algorithm=iql, not qmix"):
        LearnerConfig(crashed_loss="drop")
    with pytest.raises(ValidationError, match="gamma"):
        LearnerConfig(gamma=1.5)
    with pytest.raises(ValidationError, match="gama"):
        LearnerConfig.model_validate({"gama": 0.9})


def test_thread_count_is_left_alone() -> None:
    threads = torch.get_num_threads()
    _learner().update(_replay().sample(np.random.default_rng(0), 8), episodes=0)
    assert torch.get_num_threads() == threads
