"""The packed nets against torch's own modules and against the acting policy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from reference_learner import random_episode
from torch import nn

from policy_pkg.episode import Episode, Sizes
from policy_pkg.learner.agent_net import AgentNet
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.layers import Linear
from policy_pkg.learner.learner import Learner
from policy_pkg.learner.mixer import Qmix
from policy_pkg.learner.replay import Batch, Replay
from policy_pkg.policy import RecurrentPolicy

SIZES = Sizes(n_robots=3, n_actions=4, obs_size=5, state_size=6, episode_limit=9)


def _batch() -> tuple[Batch, list[Episode]]:
    rng = np.random.default_rng(0)
    episodes = [random_episode(SIZES, rng, steps, True) for steps in (9, 2, 5, 9, 1)]
    replay = Replay(5, SIZES)
    for episode in episodes:
        replay.add(episode)
    batch = replay.sample(rng, 5)
    return batch, [episodes[slot] for slot in batch.slots]


def _net(dtype: type[np.floating[Any]]) -> tuple[AgentNet, dict[str, np.ndarray]]:
    weights = Learner(LearnerConfig(hidden=16), SIZES, seed=0, dtype=dtype).agent_weights()
    net = AgentNet(SIZES, 16).to(torch.from_numpy(weights["fc1.bias"]).dtype)
    net.load_state_dict({name: torch.from_numpy(array) for name, array in weights.items()})
    return net, weights


def _rows(batch: Batch, dtype: type[np.floating[Any]]) -> tuple[torch.Tensor, torch.Tensor]:
    inputs = batch.inputs.astype(dtype).reshape(-1, SIZES.input_size)
    return torch.from_numpy(inputs), torch.from_numpy(batch.alive * 3).int()


def test_packed_unroll_equals_torch_gru() -> None:
    batch, _ = _batch()
    net, _ = _net(np.float64)
    inputs, counts = _rows(batch, np.float64)
    with torch.no_grad():
        actual = net(inputs, counts).view(-1, 3, 4)

    gru = nn.GRU(16, 16).double()
    names = {"rnn." + name.removesuffix("_l0"): name for name, _ in gru.named_parameters()}
    gru.load_state_dict({own: net.state_dict()[name] for name, own in names.items()})
    start = np.concatenate(([0], np.cumsum(batch.alive)))
    for i in range(len(batch.slots)):
        rows = [start[t] + i for t in range(len(batch.alive)) if i < batch.alive[t]]
        with torch.no_grad():
            x = inputs.view(-1, 3, 12)[rows]
            hidden, _ = gru(torch.relu(nn.functional.linear(x, net.fc1.weight, net.fc1.bias)))
            expected = nn.functional.linear(hidden, net.fc2.weight, net.fc2.bias)
        torch.testing.assert_close(actual[rows], expected, rtol=1e-12, atol=1e-13)


def test_values_with_and_without_a_gradient_agree_bit_for_bit() -> None:
    batch, _ = _batch()
    net, _ = _net(np.float32)
    inputs, counts = _rows(batch, np.float32)
    with_gradient = net(inputs, counts)
    assert with_gradient.requires_grad
    with torch.no_grad():
        assert torch.equal(net(inputs, counts), with_gradient)


def test_two_passes_before_one_backward_do_not_share_a_tape() -> None:
    net, _ = _net(np.float32)
    inputs, counts = _rows(_batch()[0], np.float32)

    def gradients(*passes: torch.Tensor) -> list[torch.Tensor]:
        net.zero_grad()
        values = [net(x, counts) for x in passes]
        sum(value.square().mean() for value in values).backward()
        return [p.grad.clone() for p in net.parameters() if p.grad is not None]

    apart = [gradients(x) for x in (inputs, 2 * inputs)]
    for one, two, both in zip(*apart, gradients(inputs, 2 * inputs), strict=True):
        torch.testing.assert_close(one + two, both)


def test_a_tape_is_used_once() -> None:
    net, _ = _net(np.float32)
    total = net(*_rows(_batch()[0], np.float32)).sum()
    total.backward(retain_graph=True)
    with pytest.raises(RuntimeError, match="call backward once"):
        total.backward()


def test_acting_policy_gives_the_learners_values() -> None:
    batch, episodes = _batch()
    net, params = _net(np.float32)
    with torch.no_grad():
        values = net(*_rows(batch, np.float32)).numpy().reshape(-1, 3, 4)
    policy = RecurrentPolicy(params, 3, 4)
    start = np.concatenate(([0], np.cumsum(batch.alive)))
    for i, episode in enumerate(episodes):
        hidden = policy.initial_hidden(3)
        last = np.full(3, -1, np.int32)
        for t in range(episode.length + 1):
            robots = np.arange(3, dtype=np.int32)
            q, hidden = policy.forward(episode.obs[t], last, robots, hidden)
            np.testing.assert_allclose(q, values[start[t] + i], atol=1e-6)
            if t < episode.length:
                last = episode.actions[t]


@pytest.mark.parametrize("seed", range(3))
def test_qmix_never_falls_when_a_robots_value_rises(seed: int) -> None:
    torch.manual_seed(seed)
    mixer = Qmix(SIZES, LearnerConfig(mixing_hidden=8, hypernet_hidden=16)).double()
    for parameter in mixer.parameters():
        nn.init.normal_(parameter)
    q, state = torch.randn(50, 3).double().requires_grad_(), torch.randn(50, 6).double()
    total = mixer(q, state)
    (slope,) = torch.autograd.grad(total.sum(), q)
    assert (slope >= 0).all()
    assert (slope > 0).any()
    for robot in range(3):
        more = mixer(q + 0.5 * torch.eye(3)[robot], state)
        assert (more >= total).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_our_linear_layer_is_torchs(dtype: type[np.floating[Any]]) -> None:
    torch.manual_seed(0)
    plain = nn.Linear(7, 5).to(torch.from_numpy(np.zeros(1, dtype)).dtype)
    ours = Linear(7, 5).to(plain.weight.dtype)
    ours.load_state_dict(plain.state_dict())
    x = torch.randn(33, 7, dtype=plain.weight.dtype, requires_grad=True)
    grad = torch.randn(33, 5, dtype=plain.weight.dtype)
    results = [
        (layer(x), *torch.autograd.grad(layer(x), [x, *layer.parameters()], grad))
        for layer in (plain, ours)
    ]
    for expected, found in zip(*results, strict=True):
        torch.testing.assert_close(found, expected)
