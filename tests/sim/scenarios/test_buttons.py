"""The physics of `buttons` against a grid-world written down here on its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from sim_pkg.env import Env, make_env
from sim_pkg.scenario_files import SCENARIOS_DIR

UP, DOWN, LEFT, RIGHT, STAY = range(5)


class Table:
    """The grid-world of ALGORITHM.md section 7, by table; no physics."""

    def __init__(
        self, starts: list[tuple[int, int]], buttons: list[tuple[int, int]], size: int = 10
    ) -> None:
        self.cells = list(starts)
        self.left = set(buttons)
        self.size = size
        self.steps = 0

    def move(self, cell: tuple[int, int], action: int) -> tuple[int, int]:
        row, column = cell
        if action == UP:
            row -= 1
        elif action == DOWN:
            row += 1
        elif action == LEFT:
            column -= 1
        elif action == RIGHT:
            column += 1
        inside = 0 <= row < self.size and 0 <= column < self.size
        return (row, column) if inside else cell

    def step(self, actions: list[int]) -> tuple[float, bool, bool]:
        """Reward, ended, success."""
        self.cells = [self.move(c, a) for c, a in zip(self.cells, actions, strict=True)]
        touched = self.left & set(self.cells)
        self.left -= touched
        self.steps += 1
        reward = 5.0 * len(touched) if touched else -1.0
        return reward, not self.left or self.steps == 20, not self.left


STARTS, BUTTONS = [(2, 1), (7, 8)], [(2, 4), (7, 5)]


def cells_of(env: Env, arena: int) -> list[tuple[int, int]]:
    """Cells from the physics: y points north, row 0 is the northernmost."""
    return [(9 - int(np.floor(y)), int(np.floor(x))) for x, y in env.positions_m[arena]]


def variant(tmp_path: Path, **changes: object) -> Path:
    values = yaml.safe_load((SCENARIOS_DIR / "buttons.yaml").read_text())
    path = tmp_path / "variant.yaml"
    path.write_text(yaml.safe_dump(values | changes))
    return path


def test_every_single_move(tmp_path: Path) -> None:
    """All 100 cells x 5 actions, each with a robot at rest in the middle of the cell."""
    table = Table(STARTS, BUTTONS)
    for row in range(10):
        for column in range(10):
            button = (5, 5) if (row, column) != (5, 5) else (0, 0)
            path = variant(tmp_path, starts=[[row, column]], buttons=[list(button)])
            env = make_env(path, 5)
            env.reset(np.arange(5), 0, np.arange(5))
            env.step(np.arange(5, dtype=np.int32)[:, None])
            for action in range(5):
                expected = table.move((row, column), action)
                assert cells_of(env, action) == [expected], (row, column, action)
                centre = (expected[1] + 0.5, 9.5 - expected[0])
                np.testing.assert_allclose(env.positions_m[action, 0], centre, atol=1e-6)
                np.testing.assert_array_equal(
                    env.obs[action, 0], np.array(expected, dtype=np.float64).astype("f4") / 9
                )


class BatchTable:
    """The same table over many arenas at once, for volume; numpy, no physics."""

    MOVES = np.array([(-1, 0), (1, 0), (0, -1), (0, 1), (0, 0)])

    def __init__(self, arenas: int) -> None:
        self.cells = np.tile(STARTS, (arenas, 1, 1))
        self.touched = np.zeros((arenas, 2), dtype=bool)
        self.steps = np.zeros(arenas, dtype=int)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rewards, ended, success."""
        self.cells = np.clip(self.cells + self.MOVES[actions], 0, 9)
        on = (self.cells[:, :, None] == np.array(BUTTONS)[None, None]).all(-1).any(1)
        new = (on & ~self.touched).sum(1)
        self.touched |= on
        self.steps += 1
        success: np.ndarray = self.touched.min(axis=1)
        rewards: np.ndarray = np.where(new > 0, 5.0 * new, -1.0)
        return rewards, np.logical_or(success, self.steps == 20), success

    def restart(self, arenas: np.ndarray) -> None:
        self.cells[arenas] = STARTS
        self.touched[arenas] = False
        self.steps[arenas] = 0


def biased_actions(rng: np.random.Generator, arenas: int) -> np.ndarray:
    """Random walks, half of them drawn to one direction: they reach walls and buttons often."""
    actions = rng.integers(0, 5, (arenas, 2))
    drawn = np.arange(arenas)[:, None] % 2 == 1
    pull = np.array([RIGHT, LEFT])[None, :]
    towards = np.where(rng.random((arenas, 2)) < 0.6, pull, actions)
    return np.where(drawn, towards, actions).astype(np.int32)


@pytest.mark.parametrize("episodes", [3000, pytest.param(10_000, marks=pytest.mark.soak)])
def test_random_joint_episodes(episodes: int) -> None:
    """Cell by cell, reward by reward, end by end; 64 arenas at a time."""
    arenas = 64
    env, table = make_env("buttons", arenas), BatchTable(arenas)
    rng = np.random.default_rng(20)
    env.reset(np.arange(arenas), 3, np.arange(arenas))
    finished, wins = 0, 0
    buttons = np.tile(np.ravel(BUTTONS), (arenas, 1))
    while finished < episodes:
        actions = biased_actions(rng, arenas)
        result = env.step(actions)
        rewards, ended, success = table.step(actions)
        x, y = np.floor(np.moveaxis(env.positions_m, -1, 0)).astype(int)
        np.testing.assert_array_equal(np.stack((9 - y, x), axis=-1), table.cells)
        np.testing.assert_array_equal(result.reward, rewards)
        np.testing.assert_array_equal(result.terminated, ended)
        np.testing.assert_array_equal(result.success, success)
        assert not result.truncated.any()
        expected = np.concatenate((table.cells.reshape(arenas, 4), buttons), axis=1)
        np.testing.assert_array_equal(env.state, (expected / 9).astype(np.float32))
        np.testing.assert_array_equal(env.obs, (table.cells / 9).astype(np.float32))
        over = np.flatnonzero(ended)
        wins += int(success.sum())
        finished += len(over)
        table.restart(over)
        env.reset(over, 3, arenas + finished + np.arange(len(over)))
    assert wins > episodes // 20, "too few episodes touched both buttons to test success"


def play(env: Env, moves: list[tuple[int, int]]) -> list[float]:
    env.reset(np.array([0]), 0, np.array([0]))
    return [float(env.step(np.array([m], dtype=np.int32)).reward[0]) for m in moves]


def test_the_known_optima() -> None:
    env = make_env("buttons", 1)
    assert play(env, [(RIGHT, LEFT)] * 3) == [-1, -1, 10]
    # Alone: robot_1 takes the near button after 3 steps and the far one after 9.
    lone = [RIGHT] * 3 + [DOWN] * 5 + [RIGHT]
    assert play(env, [(a, STAY) for a in lone]) == [-1, -1, 5, -1, -1, -1, -1, -1, 5]
    assert not env.running[0]


def test_pushing_walls_for_a_whole_episode_leaves_no_trace() -> None:
    env = make_env("buttons", 1)
    play(env, [(LEFT, DOWN)] * 20)
    np.testing.assert_allclose(env.positions_m[0], [(0.5, 7.5), (8.5, 0.5)], atol=1e-6)


@pytest.mark.parametrize(("name", "n", "m"), [("buttons_8", 8, 4), ("buttons_16", 16, 8)])
def test_larger_teams_follow_the_same_table(name: str, n: int, m: int) -> None:
    values = yaml.safe_load((SCENARIOS_DIR / f"{name}.yaml").read_text())
    starts = [tuple(c) for c in values["starts"]]
    buttons = [tuple(c) for c in values["buttons"]]
    env = make_env(name, 4)
    assert (env.spec.n_robots, env.spec.state_size) == (n, 2 * (n + m))
    assert env.spec.robots[0] == "robot_1"
    rng = np.random.default_rng(1)
    for episode in range(10):
        env.reset(np.arange(4), 0, np.full(4, episode))
        tables = [Table(starts, buttons) for _ in range(4)]
        running = [True] * 4
        while any(running):
            actions = rng.integers(0, 5, (4, n)).astype(np.int32)
            result = env.step(actions)
            for b in np.flatnonzero(running).tolist():
                reward, ended, _ = tables[b].step(actions[b].tolist())
                assert cells_of(env, b) == tables[b].cells
                assert result.reward[b] == reward
                running[b] = not ended
