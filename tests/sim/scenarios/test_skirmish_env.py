"""The skirmish as an environment: what is seen, allowed and rewarded; the same bits."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from skirmish_maps import Placed, load_map, random_actions, write_map

from sim_pkg.env import Env, make_env
from sim_pkg.scenarios.skirmish.config import SkirmishConfig
from sim_pkg.scenarios.skirmish.layout import FIRST_ATTACK, NO_OP, STOP
from sim_pkg.scripted.base import make_scripted
from sim_pkg.trajectory import TrajectoryHash, combine

MAPS = ("3s_vs_5z", "3s5z_vs_3s5z", "8m_vs_5z", "8s_vs_3s5z")


class Watcher:
    """Observations and masks of one arena, worked out from the bodies and the state's health."""

    def __init__(self, env: Env, config: SkirmishConfig, arena: int) -> None:
        self.config, self.layout = config, config.layout
        self.xy = env.world.bodies[arena, :, :2]
        state = self.layout.split_state(env.state[arena].astype(np.float64))
        self.health = np.concatenate((state.robots[:, 0], state.opponents[:, 0]))
        shields = [np.zeros(self.layout.n_robots), np.zeros(self.layout.n_opponents)]
        if self.layout.robot_shields:
            shields[0] = state.robots[:, 4]
        if self.layout.opponent_shields:
            shields[1] = state.opponents[:, 3]
        self.shield = np.concatenate(shields)

    def body(self, unit: int) -> list[float]:
        layout = self.layout
        mine = unit < layout.n_robots
        shielded = layout.robot_shields if mine else layout.opponent_shields
        shield = [float(self.shield[unit])] if shielded else []
        bits = layout.type_bits(self.config.placed[unit].unit).tolist()
        return [float(self.health[unit]), *shield, *bits]

    def other(self, robot: int, unit: int) -> list[float]:
        body = self.body(unit)
        away = self.xy[unit] - self.xy[robot]
        distance = float(np.linalg.norm(away))
        if distance > 9 or self.health[unit] <= 0:
            return [0.0] * (4 + len(body))
        first = 1.0 if unit < self.layout.n_robots else float(distance <= 6)
        return [first, distance / 9, away[0] / 9, away[1] / 9, *body]

    def ways(self, robot: int) -> list[float]:
        x1, y1, x2, y2 = self.config.free_m
        radius = self.config.units[robot].body_radius_m - 1e-6
        x, y = self.xy[robot]
        low, high = y1 + radius, y2 - radius
        left, right = x1 + radius, x2 - radius
        free = (low <= y + 1 <= high, low <= y - 1 <= high, left <= x + 1 <= right)
        return [float(way) for way in (*free, left <= x - 1 <= right)]

    def observation(self, robot: int) -> np.ndarray:
        n, m = self.layout.n_robots, self.layout.n_opponents
        if self.health[robot] <= 0:
            return np.zeros(self.layout.obs_size)
        parts = [self.ways(robot)]
        parts += [self.other(robot, n + j) for j in range(m)]
        parts += [self.other(robot, i) for i in range(n) if i != robot]
        return np.concatenate((*parts, self.body(robot)))

    def mask(self, robot: int) -> list[bool]:
        n, m = self.layout.n_robots, self.layout.n_opponents
        if self.health[robot] <= 0:
            return [True] + [False] * (5 + m)
        attacks = [self.other(robot, n + j)[0] == 1.0 for j in range(m)]
        return [False, True, *(way == 1.0 for way in self.ways(robot)), *attacks]


@pytest.mark.parametrize("name", MAPS)
def test_observations_masks_and_state(name: str) -> None:
    """Against a second way of working them out, over whole random episodes."""
    config = load_map(f"skirmish/{name}")
    env = make_env(f"skirmish/{name}", 2)
    layout, n = config.layout, len(config.robots)
    rng = np.random.default_rng(1)
    actions = np.full((2, n), -1, dtype=np.int32)
    deaths = 0
    env.reset(np.arange(2), 5, np.arange(2))
    while env.running.any():
        for b in np.flatnonzero(env.running).tolist():
            watcher = Watcher(env, config, b)
            expected = np.array([watcher.observation(i) for i in range(n)])
            np.testing.assert_allclose(env.obs[b], expected, atol=1e-6)
            assert env.available[b].tolist() == [watcher.mask(i) for i in range(n)]
            state = layout.split_state(env.state[b])
            one_hot = np.arange(env.spec.n_actions) == actions[b][:, None]
            np.testing.assert_array_equal(state.last_actions, one_hot)
            places = np.concatenate((state.robots[:, 2:4], state.opponents[:, 1:3]))
            alive = watcher.health > 0
            np.testing.assert_allclose(places[alive] * 32 + 16, watcher.xy[alive], atol=1e-4)
            np.testing.assert_array_equal(places[~alive], 0.0)
            deaths += int((~alive[:n]).sum())
        actions = random_actions(env, rng)
        env.step(actions)
    assert deaths > 0, "nobody died: the test is void"


def check_bounds(name: str, steps: int) -> None:
    """No feature leaves the declared bounds; who is dead can do nothing, who lives can stop."""
    env = make_env(name, 32)
    low, high = env.spec.bounds
    rng = np.random.default_rng(2)
    env.reset(np.arange(32), 1, np.arange(32))
    episode = 32
    for _ in range(steps // 32):
        for seen in (env.obs, env.state):
            assert seen.min() >= low
            assert seen.max() <= high
            assert np.isfinite(seen).all()
        assert (env.available[..., NO_OP] ^ env.available[..., STOP]).all()
        dead = env.available[..., NO_OP]
        assert not env.available[dead][:, 1:].any()
        assert not env.obs[dead].any()
        env.step(random_actions(env, rng))
        ended = np.flatnonzero(~env.running)
        env.reset(ended, 1, episode + np.arange(len(ended)))
        episode += len(ended)
    assert episode > 32


@pytest.mark.parametrize("name", MAPS)
def test_bounds(name: str) -> None:
    check_bounds(f"skirmish/{name}", 5_000)


@pytest.mark.soak
@pytest.mark.parametrize("name", MAPS)
def test_bounds_at_length(name: str) -> None:
    check_bounds(f"skirmish/{name}", 100_000)


def hashes(name: str, n_arenas: int, episodes: int) -> list[str]:
    """Trajectory hashes of random episodes; an arena starts its next one at once."""
    env = make_env(f"skirmish/{name}", n_arenas)
    result = [""] * episodes
    numbers = np.arange(n_arenas)
    digests = [TrajectoryHash(5, e) for e in range(n_arenas)]
    rngs = [np.random.default_rng([9, e]) for e in range(n_arenas)]
    env.reset(np.arange(n_arenas), 5, numbers)
    following = n_arenas
    while env.running.any():
        actions = np.zeros((n_arenas, env.spec.n_robots), dtype=np.int32)
        for b in np.flatnonzero(env.running):
            scores = rngs[b].random(env.available.shape[1:]) * env.available[b]
            actions[b] = scores.argmax(axis=-1)
            digests[b].observe(env.obs[b], env.state[b])
        before = env.running.copy()
        r = env.step(actions)
        for b in np.flatnonzero(before):
            digests[b].act(
                actions[b], float(r.reward[b]), bool(r.terminated[b]), False, bool(r.success[b])
            )
        for b in np.flatnonzero(before & ~env.running):
            result[numbers[b]] = digests[b].hexdigest()
            if following < episodes:
                numbers[b] = following
                digests[b] = TrajectoryHash(5, following)
                rngs[b] = np.random.default_rng([9, following])
                env.reset(np.array([b]), 5, np.array([following]))
                following += 1
    return result


def test_same_bits_for_1_8_and_64_arenas() -> None:
    one = hashes("2s3z", 1, 64)
    assert len(set(one)) == 64
    assert hashes("2s3z", 8, 64) == one
    assert hashes("2s3z", 64, 64) == one


def test_same_bits_in_another_process() -> None:
    code = (
        "import sys; sys.path += ['tests/support', 'tests/sim/scenarios']; "
        "import test_skirmish_env; from sim_pkg.trajectory import combine; "
        "print(combine(test_skirmish_env.hashes('3s_vs_5z', 4, 8)))"
    )
    other = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True,
        check=True, timeout=250,
    )  # fmt: skip
    assert other.stdout.strip() == combine(hashes("3s_vs_5z", 8, 8))


def test_a_won_episode_sums_to_20() -> None:
    env = make_env("skirmish/3s5z_vs_3s5z", 32)
    team = make_scripted("nearest", env)
    numbers = np.arange(32)
    env.reset(numbers, 0, numbers)
    team.begin(numbers, 0, numbers)
    sums, won = np.zeros(32), np.zeros(32, dtype=np.bool_)
    actions = np.zeros((32, env.spec.n_robots), dtype=np.int32)
    while env.running.any():
        team.act(env.obs, env.available, actions)
        result = env.step(actions)
        sums += result.reward
        won |= result.success
    assert 3 <= won.sum() <= 29, "all alike: the test is void"
    np.testing.assert_allclose(sums[won], 20.0, atol=1e-9)
    assert sums[~won].max() < 20 * (1 - 200 / (8 * 10 + 200 + 3 * 160 + 5 * 150)) + 1e-9


def test_a_timeout_is_terminal_and_no_success(tmp_path: Path) -> None:
    far: list[Placed] = [("dummy", 30.0, 30.0)]
    path = write_map(tmp_path, [("marine", 2, 2)], far, episode_limit=3)
    env = make_env(path, 1)
    env.reset(np.array([0]), 0, np.array([0]))
    for step in range(3):
        result = env.step(np.array([[STOP]], dtype=np.int32))
        assert result.terminated[0] == (step == 2)
    assert not result.success[0]
    assert not result.truncated[0]
    assert result.reward[0] == 0.0


def test_how_far_an_order_takes_a_robot(tmp_path: Path) -> None:
    """A stalker 1.4765 m, a marine 1.125 m in each step, in all directions; then they stop."""
    robots: list[Placed] = [("stalker", 10, 10), ("marine", 20, 10)]
    path = write_map(tmp_path, robots, [("dummy", 30, 30)])
    env = make_env(path, 1)
    env.reset(np.array([0]), 0, np.array([0]))
    for action, way in ((2, (0, 1)), (3, (0, -1)), (4, (1, 0)), (5, (-1, 0)), (STOP, (0, 0))):
        before = env.positions_m[0]
        env.step(np.full((1, 2), action, dtype=np.int32))
        moved = env.positions_m[0] - before
        expected = np.array(way) * np.array([[1.4765], [1.125]])
        np.testing.assert_allclose(moved, expected, atol=1e-5)


def test_the_dead_leave_the_way_free(tmp_path: Path) -> None:
    """A robot walks through the place where an opponent died."""
    weak = load_map("skirmish/3m").types["zealot"].model_dump(mode="json")
    frail = weak | {"health": 5.0, "shield": 0.0, "armour": 0.0, "speed_mps": 1e-6}
    robots: list[Placed] = [("marine", 10, 10)]
    opponents: list[Placed] = [("frail", 11.5, 10), ("dummy", 30, 30)]
    path = write_map(tmp_path, robots, opponents, unit_types={"frail": frail})
    env = make_env(path, 1)
    env.reset(np.array([0]), 0, np.array([0]))
    env.step(np.array([[FIRST_ATTACK]], dtype=np.int32))
    assert not env.available[0, 0, FIRST_ATTACK]
    for _ in range(4):
        env.step(np.array([[4]], dtype=np.int32))
    assert env.positions_m[0, 0].tolist() == pytest.approx([14.5, 10.0], abs=1e-5)
