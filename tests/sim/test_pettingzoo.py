"""PettingZoo's own conformance tests on every scenario."""

from __future__ import annotations

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

from sim_pkg.env import scenario_names
from sim_pkg.pettingzoo import ParallelArena


@pytest.mark.parametrize("name", scenario_names())
@pytest.mark.filterwarnings("error")
def test_parallel_api(name: str) -> None:
    parallel_api_test(ParallelArena(name), num_cycles=200)


@pytest.mark.parametrize("name", scenario_names())
def test_seed(name: str) -> None:
    parallel_seed_test(lambda: ParallelArena(name), num_cycles=50)


def test_an_episode_ends_for_all_with_its_success() -> None:
    arena = ParallelArena("buttons", seed=3)
    observations, infos = arena.reset()
    np.testing.assert_array_equal(observations["robot_1"] * 9, np.array([2, 1], dtype="f4"))
    assert infos["robot_2"]["action_mask"].tolist() == [1] * 5
    total = 0.0
    while arena.agents:
        _, rewards, terminated, truncated, infos = arena.step({"robot_1": 3, "robot_2": 2})
        total += rewards["robot_1"]
    assert total == 8.0
    assert terminated == {"robot_1": True, "robot_2": True}
    assert truncated == {"robot_1": False, "robot_2": False}
    assert infos["robot_1"]["success"]


def test_wrong_actions() -> None:
    arena = ParallelArena("buttons")
    arena.reset()
    with pytest.raises(ValueError, match=r"\['robot_1'\]; expected"):
        arena.step({"robot_1": 0})
    with pytest.raises(ValueError, match="action 7 of robot_2"):
        arena.step({"robot_1": 0, "robot_2": 7})
