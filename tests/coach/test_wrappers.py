"""The coach around anybody's environment: the same faults as everywhere, PettingZoo's own tests."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from corridor_env import Corridor
from pettingzoo.test import parallel_api_test, parallel_seed_test

from crash_coach_common.contract import UserError
from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.faults import mode_names
from crash_coach_pkg.faults.batch_faults import RANDOM_CODE, apply_faults
from crash_coach_pkg.team import TeamSpec
from crash_coach_pkg.wrappers import CrashWrapper, MultiAgentView
from sim_pkg.pettingzoo import ParallelArena

HALF = {"strategy": "fixed", "crash_rate": 0.5, "resample": False}


def crashed(mode: str = "mute", **settings: Any) -> CrashWrapper:
    coach = {"strategy": "fixed", "crash_mode": mode, "victims": ["slow_1"], **settings}
    return CrashWrapper(Corridor(), coach, stay_action=1, tells_worst=True)


@pytest.mark.parametrize("mode", ["mute", "random", "blind", "delay"])
def test_pettingzoos_own_tests(mode: str) -> None:
    def make() -> CrashWrapper:
        return CrashWrapper(ParallelArena("coverage"), {**HALF, "crash_mode": mode}, stay_action=0)

    parallel_api_test(make(), num_cycles=100)
    parallel_seed_test(make, num_cycles=50)


def test_a_muted_agent_stays_and_infos_say_so() -> None:
    env = crashed()
    _, infos = env.reset(seed=1)
    assert infos["slow-1"] == {"crashed": False, "executed_action": 1}
    start = dict(env.unwrapped.places)
    while env.agents:
        *_, infos = env.step(dict.fromkeys(env.agents, 2))
        if "slow-1" in infos:
            assert (infos["slow-1"]["crashed"], infos["slow-1"]["executed_action"]) == (True, 1)
        if "quick-2" in infos:
            assert (infos["quick-2"]["crashed"], infos["quick-2"]["executed_action"]) == (False, 2)
    assert env.unwrapped.places["slow-1"] == start["slow-1"]
    assert env.unwrapped.places["quick-2"] >= 6


def test_random_actions_are_those_of_training() -> None:
    """Held against the batch path, which shares no code with the wrapper's."""
    env = CrashWrapper(ParallelArena("buttons"), {**HALF, "crash_mode": "random"}, 0, seed=5)
    seen = 0
    for _ in range(8):
        env.reset()
        plan = env.plan
        assert plan is not None
        modes = np.zeros((1, 2), dtype=np.uint8)
        for fault in plan.faults:
            modes[0, fault.robot] = RANDOM_CODE
        for step in range(5):
            if not env.agents:
                break
            *_, infos = env.step(dict.fromkeys(env.agents, 4))
            key = np.array([plan.episode]), np.array([step])
            expected = apply_faults(
                np.full((1, 2), 4, np.int32), modes, np.ones((1, 2, 5), np.bool_),
                np.zeros((1, 2), np.int32), plan.seed, *key,
            )  # fmt: skip
            assert [info["executed_action"] for info in infos.values()] == expected[0].tolist()
            seen += len(plan.faults)
    assert seen > 10


@pytest.mark.parametrize("mode", sorted({*mode_names()} - {"bias", "scale"}))
def test_every_mode_plays_and_keeps_the_masks(mode: str) -> None:
    env = crashed(mode)
    differs = False
    for seed in range(4):
        plain = Corridor()
        observations, _ = env.reset(seed=seed)
        free, _ = plain.reset(seed=seed)
        rng = np.random.default_rng(seed)
        while env.agents:
            differs |= (
                not np.array_equal(
                    observations["slow-1"]["observation"], free["slow-1"]["observation"]
                )
                if "slow-1" in observations and "slow-1" in free
                else False
            )
            env.worst_actions = dict.fromkeys(env.agents, 1)
            chosen = {
                agent: 1 + int(rng.choice(np.flatnonzero(observations[agent]["action_mask"])))
                for agent in env.agents
            }
            observations, _, _, _, infos = env.step(chosen)  # the corridor asserts its masks
            free = plain._observed(plain.agents)
            if "slow-1" in infos:
                assert infos["slow-1"]["crashed"]
                differs |= infos["slow-1"]["executed_action"] != chosen["slow-1"]
    assert differs


def test_the_coach_hears_of_episodes_and_blocks() -> None:
    coach = Coach(
        CoachConfig(strategy="adaptive", adaptive={"beta": 0.5, "rho": 0.5}),
        TeamSpec(("slow_1", "quick_2")),
        0,
    )
    training = CrashWrapper(Corridor(), coach, stay_action=1)
    testing = CrashWrapper(Corridor(), coach, stay_action=1)
    for episode in range(4):
        training.reset(seed=episode)
        training.end_episode(True, env_steps=20 * (episode + 1), total_steps=1000)
    record = training.end_block(0.9, env_steps=80, total_steps=1000)
    assert (record.rate, record.new_rate, record.episodes) == (0.0, 0.5, 4)
    assert testing.coach.rate == 0.5
    testing.reset(seed=3)
    assert testing.plan is not None
    assert testing.plan.rate == 0.5
    training.end_block(0.0, env_steps=160, total_steps=1000)
    assert testing.coach.rate == 0.25


@pytest.mark.parametrize(
    ("settings", "stay", "text"),
    [
        ({"strategy": "fixed", "victims": ["nobody"]}, 1, "nobody"),
        ({"strategy": "fixed", "crash_mode": "adversarial"}, 1, "tells_worst"),
        ({"strategy": "fixed", "near_radius_m": 1.0}, 1, "near_radius_m"),
        ({"strategy": "fixed", "crash_mode": "bias"}, 1, "velocities"),
        ({"strategy": "sometimes"}, 1, "unknown coaching strategy"),
        ({}, 0, "stay_action 0"),
    ],
)
def test_what_does_not_fit_is_refused(settings: dict[str, Any], stay: int, text: str) -> None:
    with pytest.raises(UserError, match=text):
        CrashWrapper(Corridor(), settings, stay_action=stay)
    with pytest.raises(UserError, match="reset the environment"):
        crashed().step({})


def test_the_view_that_epymarl_expects() -> None:
    env = CrashWrapper(
        ParallelArena("skirmish/3m"), {"strategy": "fixed", "victims": ["robot_2"]}, 1
    )
    view = MultiAgentView(env, stay_action=0, episode_limit=60)
    observations, _ = view.reset(seed=2)
    info = view.get_env_info()
    assert info == {
        "state_shape": 48, "obs_shape": 30, "n_actions": 9, "n_agents": 3, "episode_limit": 60,
    }  # fmt: skip
    assert view.observation_space.contains(observations)
    rng, total, terminated, truncated, steps = np.random.default_rng(0), 0.0, False, False, 0
    while not (terminated or truncated):
        masks = view.get_avail_actions()
        assert [len(mask) for mask in masks] == [9, 9, 9]
        actions = [int(rng.choice(np.flatnonzero(mask))) for mask in masks]
        observations, rewards, terminated, truncated, infos = view.step(actions)
        total, steps = total + rewards[0], steps + 1
        assert rewards[0] == rewards[1] == rewards[2]
        if steps == 1:
            assert infos["crashed"] == [False, True, False]
            assert infos["executed_action"][1] == 1
    assert steps <= 60
    assert view.get_avail_actions() == [[1, *[0] * 8]] * 3
    assert len(view.get_state()) == 48


def test_it_needs_neither_ros_nor_torch_nor_the_simulator() -> None:
    code = (
        "import sys\n"
        "for name in ('rclpy', 'torch', 'numba', 'pymunk', 'sim_pkg', 'policy_pkg', 'yaml'):\n"
        "    sys.modules[name] = None\n"
        "import crash_coach_pkg.wrappers"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=250).returncode == 0
