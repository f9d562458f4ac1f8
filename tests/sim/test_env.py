"""The contract that every scenario keeps."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from crash_coach_common.contract import BatchEnv
from sim_pkg.env import Env, make_env, scenario_names
from sim_pkg.trajectory import TrajectoryHash, combine

ACTION_SEED = 7


def hashes(n_arenas: int, episodes: int) -> list[str]:
    """Trajectory hashes of random episodes, played ``n_arenas`` at a time."""
    env = make_env("buttons", n_arenas)
    result = []
    for first in range(0, episodes, n_arenas):
        numbers = np.arange(first, first + n_arenas)
        env.reset(np.arange(n_arenas), 5, numbers)
        digests = [TrajectoryHash(5, int(e)) for e in numbers]
        rngs = [np.random.default_rng([ACTION_SEED, int(e)]) for e in numbers]
        while env.running.any():
            running = np.flatnonzero(env.running)
            actions = np.zeros((n_arenas, 2), dtype=np.int32)
            for b in running:
                actions[b] = rngs[b].integers(0, 5, 2)
                digests[b].observe(env.obs[b], env.state[b])
            r = env.step(actions)
            for b in running:
                digests[b].act(
                    actions[b],
                    float(r.reward[b]),
                    bool(r.terminated[b]),
                    bool(r.truncated[b]),
                    bool(r.success[b]),
                )
        result += [d.hexdigest() for d in digests]
    return result


def test_same_bits_for_1_8_and_64_arenas() -> None:
    one = hashes(1, 64)
    assert len(set(one)) == 64
    assert hashes(8, 64) == one
    assert hashes(64, 64) == one


def test_same_bits_in_another_process() -> None:
    code = (
        "import sys; sys.path += ['tests/support', 'tests/sim']; import test_env; "
        "from sim_pkg.trajectory import combine; print(combine(test_env.hashes(4, 16)))"
    )
    other = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=250
    )
    assert other.stdout.strip() == combine(hashes(16, 16))


def test_arenas_end_and_restart_on_their_own() -> None:
    env = make_env("buttons", 2)
    env.reset(np.array([1]), 0, np.array([0]))
    for _ in range(5):
        result = env.step(np.full((2, 2), 4, dtype=np.int32))
    assert result.reward.tolist() == [0.0, -1.0]
    env.reset(np.array([0]), 0, np.array([1]))
    for _ in range(15):
        result = env.step(np.full((2, 2), 4, dtype=np.int32))
    assert result.terminated.tolist() == [False, True]
    assert not result.success[1]
    result = env.step(np.full((2, 2), 4, dtype=np.int32))
    assert env.running.tolist() == [True, False]
    assert result.reward.tolist() == [-1.0, 0.0]
    assert not result.terminated.any()


@pytest.mark.parametrize("name", scenario_names())
def test_bounds_masks_and_shapes(name: str) -> None:
    env: BatchEnv = make_env(name, 3)
    spec = env.spec
    rng = np.random.default_rng(0)
    for episode in range(5):
        env.reset(np.arange(3), 1, np.full(3, episode))
        for _ in range(spec.episode_limit):
            assert env.obs.shape == (3, spec.n_robots, spec.obs_size)
            assert env.obs.dtype == env.state.dtype == env.positions_m.dtype == np.float32
            assert env.state.shape == (3, spec.state_size)
            assert env.positions_m.shape == (3, spec.n_robots, 2)
            assert env.available.shape == (3, spec.n_robots, spec.n_actions)
            assert env.available.any(axis=-1).all()
            for seen in (env.obs, env.state):
                assert seen.min() >= spec.bounds[0]
                assert seen.max() <= spec.bounds[1]
            scores = rng.random(env.available.shape) * env.available
            env.step(scores.argmax(axis=-1).astype(np.int32))


@pytest.fixture
def env() -> Env:
    env = make_env("buttons", 2)
    env.reset(np.arange(2), 0, np.arange(2))
    return env


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((2, 3), dtype=np.int32), r"shape \(2, 3\).*expected \(2, 2\)"),
        (np.zeros(2, dtype=np.int32), r"shape \(2,\)"),
        (np.zeros((2, 2)), "float64"),
        (np.array([[0, 0], [0, 5]], dtype=np.int32), "action 5 of robot_2 in arena 1"),
        (np.array([[-1, 0], [0, 0]], dtype=np.int32), "action -1 of robot_1 in arena 0"),
    ],
)
def test_wrong_actions_are_refused(env: Env, actions: np.ndarray, message: str) -> None:
    before = env.positions_m
    with pytest.raises(ValueError, match=message):
        env.step(actions)
    np.testing.assert_array_equal(env.positions_m, before)


def test_actions_of_ended_arenas_are_ignored(env: Env) -> None:
    for _ in range(20):
        env.step(np.full((2, 2), 4, dtype=np.int32))
    assert not env.running.any()
    env.step(np.full((2, 2), 99, dtype=np.int32))


@pytest.mark.parametrize(
    ("arenas", "seed", "episodes", "message"),
    [
        ([2], 0, [0], "no arena 2"),
        ([0, 0], 0, [1, 2], "named twice"),
        ([0, 1], 0, [1], "do not match"),
        ([0], -1, [0], "seed -1"),
        ([0], 0, [-3], "episode -3"),
    ],
)
def test_wrong_resets_are_refused(
    env: Env, arenas: list[int], seed: int, episodes: list[int], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        env.reset(np.array(arenas), seed, np.array(episodes))


def test_at_least_one_arena() -> None:
    with pytest.raises(ValueError, match="n_arenas is 0"):
        make_env("buttons", 0)
