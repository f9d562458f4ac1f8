"""Our scenarios as others' trainers take them: PettingZoo's own tests, names, pictures."""

from __future__ import annotations

import os
import shutil
import subprocess
from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

from crash_coach_common.contract import UserError
from policy_pkg.play.own_envs import parallel_env, registered_name
from sim_pkg.env import scenario_names

HALF = {"strategy": "fixed", "crash_rate": 0.5, "resample": False}
ALWAYS = {**HALF, "crash_rate": 1.0, "min_alive": 0}
SCENARIOS = ("buttons", "coverage", "transport", "skirmish/3m")


@pytest.mark.parametrize("name", SCENARIOS)
@pytest.mark.parametrize("mode", ["mute", "random"])
def test_pettingzoos_own_tests(name: str, mode: str) -> None:
    def make() -> Any:
        return parallel_env(name, {**HALF, "crash_mode": mode}, seed=3)

    parallel_api_test(make(), num_cycles=60)
    parallel_seed_test(make, num_cycles=40)


def test_every_scenario_has_a_name() -> None:
    for scenario in scenario_names():
        env = gymnasium.make(f"policy_pkg.play.own_envs:{registered_name(scenario)}", coach=HALF)
        observations, _ = env.reset(seed=1)
        info = env.unwrapped.get_env_info()
        assert len(observations) == info["n_agents"]
        masks = env.unwrapped.get_avail_actions()
        _, rewards, *_ = env.step([mask.index(1) for mask in masks])
        assert len(rewards) == info["n_agents"]


def test_roles_and_seconds_per_step_are_the_scenarios() -> None:
    env = parallel_env("skirmish/2s3z", {**ALWAYS, "victim_role": "zealot"})
    env.reset(seed=1)
    assert {env.coach.team.roles[fault.robot] for fault in env.plan.faults} == {"zealot"}
    assert env.coach.team.dt_s == 0.5


def played(env: Any, steps: int) -> list[Any]:
    """A picture before each step and after the last one."""
    pictures = []
    _, infos = env.reset(seed=5)
    rng = np.random.default_rng(0)
    for _ in range(steps):
        pictures.append(env.render())
        masks = {agent: infos[agent]["action_mask"] for agent in env.agents}
        *_, infos = env.step({a: int(rng.choice(np.flatnonzero(m))) for a, m in masks.items()})
    return [*pictures, env.render()]


def test_pictures_show_the_arena_as_it_is() -> None:
    plain = played(parallel_env("buttons", render_mode="rgb_array"), 4)
    again = played(parallel_env("buttons", render_mode="rgb_array"), 4)
    coach = {"strategy": "fixed", "victims": ["robot_1"]}
    faulted = played(parallel_env("buttons", coach, "rgb_array"), 4)
    assert all(p.dtype == np.uint8 and p.shape == plain[0].shape for p in [*plain, *faulted])
    assert all((one == other).all() for one, other in zip(plain, again, strict=True))
    assert all((one != other).any() for one, other in pairwise(plain))
    grey = [int((picture == (154, 154, 154)).all(axis=-1).sum()) for picture in (*plain, *faulted)]
    # A disc of the crashed robot's colour, beside the legend's.
    assert max(grey[:5]) < 200 < 1000 < min(grey[6:])
    skirmish = played(parallel_env("skirmish/3m", coach, "rgb_array"), 12)
    assert len({picture.shape for picture in skirmish}) == 1


def test_what_does_not_fit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="render_mode 'ansi': None or one of rgb_array, human"):
        parallel_env("buttons", render_mode="ansi")
    with pytest.raises(UserError, match="make it with a render_mode"):
        parallel_env("buttons").render()
    with pytest.raises(UserError, match="reset the environment first"):
        parallel_env("buttons", render_mode="rgb_array").render()
    with pytest.raises(UserError, match="nobody"):
        parallel_env("buttons", {"strategy": "fixed", "victims": ["nobody"]})
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(UserError, match=r"needs a display|needs Tk"):
        parallel_env("buttons", render_mode="human")


@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="no Xvfb to show a window on")
def test_a_window_where_there_is_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("tkinter", reason="Python without Tk")
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "1024x1100x24", "-nolisten", "tcp"]
    server = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
    try:
        os.close(write)
        monkeypatch.setenv("DISPLAY", f":{os.read(read, 16).decode().strip()}")
        env = parallel_env("buttons", {"strategy": "fixed", "victims": ["robot_1"]}, "human")
        env.reset(seed=1)
        env.step({"robot_1": 0, "robot_2": 1})
        window = env.unwrapped._window
        assert (window._label.winfo_width(), window._label.winfo_height()) == (900, 998)
        assert env.render() is None
        window._root.destroy()  # as a click on its cross
        env.step({"robot_1": 0, "robot_2": 1})
        env.close()
    finally:
        server.kill()
        server.wait(10)
        os.close(read)
