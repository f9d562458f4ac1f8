"""The packed nets against torch's own modules and against the acting policy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from reference_learner import random_episode
from torch import nn

from policy_pkg.episode import Episode, Sizes
from policy_pkg.learner import agent_net, mixer
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import Learner
from policy_pkg.learner.packed_gru import Schedule
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


def _params(dtype: type[np.floating[Any]]) -> dict[str, np.ndarray]:
    return Learner(LearnerConfig(hidden=16), SIZES, seed=0, dtype=dtype).agent_weights()


def test_packed_unroll_equals_torch_gru() -> None:
    batch, _ = _batch()
    arrays = _params(np.float64)
    wide = batch.inputs.astype(np.float64)
    schedule = Schedule([int(rows) * 3 for rows in batch.alive])
    packed = agent_net.values(arrays, wide.reshape(-1, SIZES.input_size), schedule)
    params = {name: torch.from_numpy(array) for name, array in arrays.items()}
    inputs, actual = torch.from_numpy(wide), torch.from_numpy(packed)

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


def test_values_with_and_without_tape_agree_bit_for_bit() -> None:
    batch, _ = _batch()
    inputs = batch.inputs.reshape(-1, SIZES.input_size)
    schedule = Schedule([int(rows) * 3 for rows in batch.alive])
    params = _params(np.float32)
    with_tape, _ = agent_net.values_and_tape(params, inputs, schedule)
    assert np.array_equal(with_tape, agent_net.values(params, inputs, schedule))


def test_acting_policy_gives_the_learners_values() -> None:
    batch, episodes = _batch()
    params = _params(np.float32)
    schedule = Schedule([int(rows) * 3 for rows in batch.alive])
    values = agent_net.values(params, batch.inputs.reshape(-1, SIZES.input_size), schedule).reshape(
        -1, 3, 4
    )
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
    named, _ = mixer.qmix_shapes(SIZES, 8, 16)
    rng = np.random.default_rng(seed)
    params = {name: rng.standard_normal(shape) for name, shape in named.items()}
    q, state = rng.standard_normal((50, 3)), rng.standard_normal((50, 6))
    total, tape = mixer.qmix(params, q, state)
    out = {name: np.empty_like(param) for name, param in params.items()}
    slope = mixer.qmix_gradients(params, tape, np.ones(50), out)
    assert (slope >= 0).all()
    assert (slope > 0).any()
    for robot in range(3):
        more, _ = mixer.qmix(params, q + 0.5 * np.eye(3)[robot], state)
        assert (more >= total).all()
