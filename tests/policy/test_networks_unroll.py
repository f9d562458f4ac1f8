"""The packed nets against torch's own modules and against the acting policy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference_learner import random_episode
from torch import Tensor, nn

from policy_pkg.policy import RecurrentPolicy
from policy_pkg.train import agent_net, mixer
from policy_pkg.train.episode import Episode, Sizes
from policy_pkg.train.learner import Learner
from policy_pkg.train.learner_config import LearnerConfig
from policy_pkg.train.packed_gru import Schedule
from policy_pkg.train.replay import Batch, Replay

SIZES = Sizes(n_robots=3, n_actions=4, obs_size=5, state_size=6, episode_limit=9)


def _batch() -> tuple[Batch, list[Episode]]:
    rng = np.random.default_rng(0)
    episodes = [random_episode(SIZES, rng, steps, True) for steps in (9, 2, 5, 9, 1)]
    replay = Replay(5, SIZES)
    for episode in episodes:
        replay.add(episode)
    batch = replay.sample(rng, 5)
    return batch, [episodes[slot] for slot in batch.slots]


def _params(dtype: torch.dtype) -> dict[str, Tensor]:
    learner = Learner(LearnerConfig(hidden=16), SIZES, seed=0, dtype=dtype)
    return {name: torch.from_numpy(array) for name, array in learner.agent_weights().items()}


def test_packed_unroll_equals_torch_gru() -> None:
    batch, _ = _batch()
    params = _params(torch.float64)
    inputs = torch.from_numpy(batch.inputs).double()
    schedule = Schedule([int(rows) * 3 for rows in batch.alive])
    actual = agent_net.unroll_values(params, inputs.view(-1, SIZES.input_size), schedule)

    fc1, fc2, gru = nn.Linear(12, 16).double(), nn.Linear(16, 4).double(), nn.GRU(16, 16).double()
    names = {"rnn." + name.removesuffix("_l0"): name for name, _ in gru.named_parameters()}
    gru.load_state_dict({own: params[name] for name, own in names.items()})
    for layer, name in ((fc1, "fc1"), (fc2, "fc2")):
        layer.load_state_dict({k: params[f"{name}.{k}"] for k in ("weight", "bias")})
    start = np.concatenate(([0], np.cumsum(batch.alive)))
    for i in range(len(batch.slots)):
        rows = [start[t] + i for t in range(len(batch.alive)) if i < batch.alive[t]]
        with torch.no_grad():
            hidden, _ = gru(torch.relu(fc1(inputs[rows])))
            expected = fc2(hidden)
        torch.testing.assert_close(actual.view(-1, 3, 4)[rows], expected, rtol=1e-12, atol=1e-13)


def test_unroll_with_and_without_gradient_agree_bit_for_bit() -> None:
    batch, _ = _batch()
    params = _params(torch.float32)
    inputs = torch.from_numpy(batch.inputs).view(-1, SIZES.input_size)
    schedule = Schedule([int(rows) * 3 for rows in batch.alive])
    with_gradient = agent_net.unroll(
        {name: param.clone().requires_grad_() for name, param in params.items()}, inputs, schedule
    )
    assert with_gradient.requires_grad
    without = agent_net.unroll_values(params, inputs, schedule)
    assert not without.requires_grad
    assert torch.equal(with_gradient.detach(), without)


def test_acting_policy_gives_the_learners_values() -> None:
    batch, episodes = _batch()
    params = _params(torch.float32)
    schedule = Schedule([int(rows) * 3 for rows in batch.alive])
    values = agent_net.unroll_values(
        params, torch.from_numpy(batch.inputs).view(-1, SIZES.input_size), schedule
    ).view(-1, 3, 4)
    policy = RecurrentPolicy({k: v.numpy() for k, v in params.items()}, 3, 4)
    start = np.concatenate(([0], np.cumsum(batch.alive)))
    for i, episode in enumerate(episodes):
        hidden = policy.initial_hidden(3)
        last = np.full(3, -1, np.int32)
        for t in range(episode.length + 1):
            robots = np.arange(3, dtype=np.int32)
            q, hidden = policy.forward(episode.obs[t], last, robots, hidden)
            np.testing.assert_allclose(q, values[start[t] + i].numpy(), atol=1e-6)
            if t < episode.length:
                last = episode.actions[t]


@pytest.mark.parametrize("seed", range(3))
def test_qmix_never_falls_when_a_robots_value_rises(seed: int) -> None:
    named, _ = mixer.qmix_shapes(SIZES, 8, 16)
    torch.manual_seed(seed)
    params = {name: torch.randn(shape, dtype=torch.float64) for name, shape in named.items()}
    q = torch.randn(50, 3, dtype=torch.float64, requires_grad=True)
    total = mixer.qmix(params, q, torch.randn(50, 6, dtype=torch.float64))
    (slope,) = torch.autograd.grad(total.sum(), q)
    assert bool((slope >= 0).all())
    assert bool((slope > 0).any())


def test_vdn_is_the_sum() -> None:
    q = torch.tensor([[1.0, 2.0, 4.0], [-1.0, 0.5, 0.0]])
    assert mixer.vdn(q).tolist() == [7.0, -0.5]
