"""Gate and coach alone: without simulator and policies, without pymunk, torch and numba."""

from __future__ import annotations

import os
from pathlib import Path

from coach_graph import graph, process, run_to_end

BLOCKED = ("sim_pkg", "policy_pkg", "crash_coach_bringup", "pymunk", "torch", "numba")
CUSTOMIZE = f"""
import sys


class Bare:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {BLOCKED!r}:
            raise ModuleNotFoundError(f"not installed here: {{name}}")


sys.meta_path.insert(0, Bare())
"""


def bare(env: dict[str, str], folder: Path) -> dict[str, str]:
    """An environment in which these cannot be imported, in no process."""
    (folder / "sitecustomize.py").write_text(CUSTOMIZE)
    return {**env, "PYTHONPATH": os.pathsep.join((str(folder), env.get("PYTHONPATH", "")))}


def test_faults_reach_the_robots(ros_env: dict[str, str], tmp_path: Path) -> None:
    with graph(bare(ros_env, tmp_path), victims=("robot_2",), start_step=2) as g:
        faulted = [[each.faulted for each in g.team.step(0, step)] for step in range(5)]
    assert faulted == [[False] * 3] * 2 + [[False, True, False]] * 3


def test_twist_commands_too(ros_env: dict[str, str], tmp_path: Path) -> None:
    """The gate of other types: it refuses a type by looking at it, so it got as far as that."""
    code, said = run_to_end(
        bare(ros_env, tmp_path),
        "gate",
        robots=("rover_1",),
        command_type="geometry_msgs/msg/Twisted",
        raw_topic="cmd_vel_raw",
        command_topic="cmd_vel",
        dt_s=0.05,
    )
    assert code == 1
    assert "Twisted" in said
    assert "not installed here" not in said


def test_the_wall_is_there(ros_env: dict[str, str], tmp_path: Path) -> None:
    with process(bare(ros_env, tmp_path), "sim", "sim_pkg", scenario="buttons") as sim:
        _, said = sim.communicate(timeout=250)
    assert sim.returncode != 0
    assert "not installed here" in said
