"""The numpy forward pass: equal to torch's, and the same bits for every batch."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch
from policy_weights import random_weights

from policy_pkg.act import Explorer, greedy
from policy_pkg.episode import Episode, Sizes
from policy_pkg.learner.agent_net import AgentNet
from policy_pkg.learner.config import LearnerConfig
from policy_pkg.learner.learner import Learner
from policy_pkg.learner.replay import Replay
from policy_pkg.policy import RecurrentPolicy

SIZES = Sizes(n_robots=3, n_actions=6, obs_size=7, state_size=4, episode_limit=9)


def weights_of(sizes: Sizes, hidden: int = 64, seed: int = 0) -> dict[str, np.ndarray]:
    return random_weights(sizes.input_size, hidden, sizes.n_actions, seed)


def make_policy(sizes: Sizes = SIZES, hidden: int = 64) -> RecurrentPolicy:
    return RecurrentPolicy(weights_of(sizes, hidden), sizes.n_robots, sizes.n_actions)


def random_episode(rng: np.random.Generator, steps: int) -> Episode:
    n, a = SIZES.n_robots, SIZES.n_actions
    return Episode(
        obs=rng.standard_normal((steps + 1, n, SIZES.obs_size)).astype(np.float32),
        state=rng.standard_normal((steps + 1, SIZES.state_size)).astype(np.float32),
        available=np.ones((steps + 1, n, a), dtype=np.bool_),
        actions=rng.integers(a, size=(steps, n)).astype(np.int32),
        reward=rng.standard_normal(steps).astype(np.float32),
        faults=np.zeros((steps, n), dtype=np.uint8),
        terminated=True,
    )


def test_agrees_with_the_learners_agent_net_along_whole_episodes() -> None:
    rng = np.random.default_rng(1)
    episodes = [random_episode(rng, steps) for steps in (9, 4, 1)]  # longest first, as packed
    replay = Replay(len(episodes), SIZES)
    for episode in episodes:
        replay.add(episode)
    batch = replay.gather(np.arange(len(episodes)))
    weights = Learner(LearnerConfig(), SIZES, seed=2).agent_weights()
    n = SIZES.n_robots
    packed_rows = batch.inputs.reshape(-1, SIZES.input_size)
    net = AgentNet(SIZES, 64)
    net.load_state_dict({name: torch.from_numpy(array) for name, array in weights.items()})
    with torch.no_grad():
        counts = torch.from_numpy(batch.alive * n).int()
        learner_q = net(torch.from_numpy(packed_rows), counts).numpy()
    packed = learner_q.reshape(-1, n, SIZES.n_actions)

    policy = RecurrentPolicy(weights, n, SIZES.n_actions)
    robots = np.arange(n, dtype=np.int32)
    hidden = [policy.initial_hidden(n) for _ in episodes]
    row = 0
    for t, alive in enumerate(batch.alive):
        for i in range(alive):
            last = episodes[i].actions[t - 1] if t else np.full(n, -1, dtype=np.int32)
            q, hidden[i] = policy.forward(episodes[i].obs[t], last, robots, hidden[i])
            np.testing.assert_allclose(q, packed[row], rtol=0, atol=1e-6)
            row += 1
    assert row == len(packed)


def test_agrees_with_torchs_own_layers() -> None:
    """Linear, GRUCell, Linear on the concatenated one-hots, as PyMARL's RNNAgent computes it."""
    hidden_size, rows = 64, 300
    weights = {name: torch.from_numpy(a) for name, a in weights_of(SIZES).items()}
    cell = torch.nn.GRUCell(hidden_size, hidden_size)
    names = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
    cell.load_state_dict({name: weights[f"rnn.{name}"] for name in names})
    policy = make_policy()
    rng = np.random.default_rng(6)
    robot = rng.integers(SIZES.n_robots, size=rows).astype(np.int32)
    mine, theirs = policy.initial_hidden(rows), torch.zeros(rows, hidden_size)
    for step in range(30):
        obs = rng.uniform(-1, 1, (rows, SIZES.obs_size)).astype(np.float32)
        last = rng.integers(-1, SIZES.n_actions, size=rows).astype(np.int32)
        one_hots = np.concatenate(
            [np.eye(SIZES.n_actions + 1)[last][:, :-1], np.eye(SIZES.n_robots)[robot]], axis=1
        )
        inputs = torch.from_numpy(np.concatenate([obs, one_hots], axis=1).astype(np.float32))
        with torch.no_grad():
            first = torch.nn.functional.linear(inputs, weights["fc1.weight"], weights["fc1.bias"])
            theirs = cell(first.relu(), theirs)
            expected = torch.nn.functional.linear(
                theirs, weights["fc2.weight"], weights["fc2.bias"]
            )
        q, mine = policy.forward(obs, last, robot, mine)
        scale = float(expected.abs().max())
        np.testing.assert_allclose(
            q, expected.numpy(), rtol=0, atol=1e-6 * scale, err_msg=str(step)
        )


@pytest.mark.parametrize("hidden", [64, 20])
def test_a_row_has_the_same_bits_in_every_batch(hidden: int) -> None:
    policy = make_policy(hidden=hidden)
    rng = np.random.default_rng(3)
    rows = 2048
    obs = rng.standard_normal((rows, SIZES.obs_size)).astype(np.float32)
    last = rng.integers(-1, SIZES.n_actions, size=rows).astype(np.int32)
    robot = rng.integers(SIZES.n_robots, size=rows).astype(np.int32)
    before = rng.standard_normal((rows, hidden)).astype(np.float32)
    all_q, all_hidden = policy.forward(obs, last, robot, before)
    for size in [*range(1, 41), 63, 64, 65, 100, 256, 511, 1000, 2047]:
        for start in (0, 1, 5, rows - size):
            part = slice(start, start + size)
            expected_q, expected_hidden = all_q[part], all_hidden[part]
            count = len(expected_q)
            q, after = policy.forward(obs[part], last[part], robot[part], before[part])
            assert q.shape == (count, SIZES.n_actions)
            np.testing.assert_array_equal(q, expected_q)
            np.testing.assert_array_equal(after, expected_hidden)


def test_results_are_not_overwritten_by_the_next_call() -> None:
    policy = make_policy()
    ones = np.ones((2, SIZES.obs_size), dtype=np.float32)
    index = np.zeros(2, dtype=np.int32)
    q, hidden = policy.forward(ones, index, index, policy.initial_hidden(2))
    kept = q.copy(), hidden.copy()
    policy.forward(-ones, index, index, hidden)
    np.testing.assert_array_equal(q, kept[0])
    np.testing.assert_array_equal(hidden, kept[1])


def test_set_weights_acts_like_a_new_policy_and_copies() -> None:
    policy = make_policy()
    other = weights_of(SIZES, seed=9)
    policy.set_weights(other)
    obs = np.ones((3, SIZES.obs_size), dtype=np.float32)
    index = np.arange(3, dtype=np.int32)
    fresh = RecurrentPolicy(weights_of(SIZES, seed=9), SIZES.n_robots, SIZES.n_actions)
    for array in other.values():
        array[...] = 0
    expected = fresh.forward(obs, index, index, fresh.initial_hidden(3))
    for got, wanted in zip(
        policy.forward(obs, index, index, policy.initial_hidden(3)), expected, strict=True
    ):
        np.testing.assert_array_equal(got, wanted)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("fc2.bias", lambda a: a[:-1], r"fc2\.bias has shape \(5,\), expected \(6,\)"),
        ("rnn.weight_hh", lambda a: a.T.copy(), r"rnn\.weight_hh has shape"),
        ("fc1.weight", lambda a: a[:, :9], r"fc1\.weight has shape \(64, 9\)"),
        ("rnn.bias_ih", lambda a: a * np.nan, r"rnn\.bias_ih holds values that are not finite"),
    ],
)
def test_wrong_weights_are_refused_by_name(name: str, change, message: str) -> None:  # type: ignore[no-untyped-def]
    weights = weights_of(SIZES)
    weights[name] = change(weights[name])
    with pytest.raises(ValueError, match=message):
        RecurrentPolicy(weights, SIZES.n_robots, SIZES.n_actions)


def test_missing_and_unknown_weights_are_named() -> None:
    weights = weights_of(SIZES)
    weights["fc3.bias"] = weights.pop("fc2.bias")
    with pytest.raises(ValueError, match=r"missing \['fc2\.bias'\], unknown \['fc3\.bias'\]"):
        RecurrentPolicy(weights, SIZES.n_robots, SIZES.n_actions)


def test_forward_refuses_shapes_that_do_not_fit() -> None:
    policy = make_policy()
    index = np.zeros(2, dtype=np.int32)
    with pytest.raises(ValueError, match="expected"):
        policy.forward(np.zeros((2, 8), np.float32), index, index, policy.initial_hidden(2))


def test_greedy_takes_the_best_available_and_the_first_of_equals() -> None:
    q = np.array([[1, 5, 3], [2, 2, 2], [-5, -9, 0]], dtype=np.float32)
    available = np.array([[True, False, True], [False, True, True], [True, True, False]])
    assert greedy(q, available).tolist() == [2, 1, 0]
    assert greedy(q, available).dtype == np.int32


def test_epsilon_greedy_explores_each_robot_on_its_own_and_only_the_available() -> None:
    rows, epsilon = 60_000, 0.3
    q = np.tile(np.array([0, 1, 9, 2], dtype=np.float32), (rows, 1))
    available = np.tile(np.array([True, True, False, True]), (rows, 1))
    explorer = Explorer(rows, 1)
    actions = explorer.choose(q[:, None], available[:, None], epsilon, np.random.default_rng(4))
    actions = actions[:, 0]
    share = np.bincount(actions, minlength=4) / rows
    third = epsilon / 3
    np.testing.assert_allclose(share, [third, third, 0, 1 - epsilon + third], atol=0.01)
    other = actions.reshape(-1, 2) != 3  # two robots: both deviate as often as independence says
    assert other.all(axis=1).mean() == pytest.approx((epsilon * 2 / 3) ** 2, abs=0.005)


def test_epsilon_zero_is_greedy_and_one_is_uniform() -> None:
    rng = np.random.default_rng(5)
    q = rng.standard_normal((500, 4, 6)).astype(np.float32)
    available = rng.random((500, 4, 6)) < 0.5
    available[..., 0] = True
    explorer = Explorer(500, 4)
    np.testing.assert_array_equal(explorer.choose(q, available, 0.0, rng), greedy(q, available))
    explored = explorer.choose(q, available, 1.0, rng)
    assert np.take_along_axis(available, explored[..., None], axis=-1).all()


def test_acting_does_not_load_torch() -> None:
    code = "import sys, policy_pkg.checkpoint, policy_pkg.act; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=250).returncode == 0
