"""Gate and coach alone, in an environment of ROS, numpy and their own package: no simulator, no
policies, no pymunk, torch and numba."""

from __future__ import annotations

import subprocess
from pathlib import Path

import bare_environment
import coach_graph
import pytest
from coach_graph import graph, run_to_end
from node_process import start_file

ABSENT = ("sim_pkg", "policy_pkg", "crash_coach_bringup", "pymunk", "torch", "numba")
NEEDED = ("numpy", "pydantic", "pyyaml", "ros-diagnostic-msgs", "ros-std-srvs")

pytestmark = bare_environment.needs_wheels


@pytest.fixture(scope="module")
def venv(tmp_path_factory: pytest.TempPathFactory) -> Path:
    ours = dict.fromkeys(("ros_ws/src/crash_coach_common", "crash_coach_pkg"), "")
    return bare_environment.make(tmp_path_factory.mktemp("bare"), ours, *NEEDED)


@pytest.fixture
def bare(venv: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gate and coach are those of the bare environment."""

    def start(
        name: str, package: str, arguments: list[str], env: dict[str, str]
    ) -> subprocess.Popen[str]:
        assert package == "crash_coach_pkg"
        return start_file([str(bare_environment.program(venv, name, tmp_path)), *arguments], env)

    monkeypatch.setattr(coach_graph, "start", start)


def test_nothing_else_is_there(venv: Path) -> None:
    assert bare_environment.found(venv, *ABSENT, "numpy", "crash_coach_pkg") == [
        "numpy",
        "crash_coach_pkg",
    ]


@pytest.mark.usefixtures("bare")
def test_faults_reach_the_robots(ros_env: dict[str, str]) -> None:
    with graph(ros_env, victims=("robot_2",), start_step=2) as g:
        faulted = [[each.faulted for each in g.team.step(0, step)] for step in range(5)]
    assert faulted == [[False] * 3] * 2 + [[False, True, False]] * 3


@pytest.mark.usefixtures("bare")
def test_twist_commands_too(ros_env: dict[str, str]) -> None:
    """The gate of other types: it refuses a type by looking at it, so it got as far as that."""
    code, said = run_to_end(
        ros_env,
        "gate",
        robots=("rover_1",),
        command_type="geometry_msgs/msg/Twisted",
        raw_topic="cmd_vel_raw",
        command_topic="cmd_vel",
        dt_s=0.05,
    )
    assert code == 1
    assert "Twisted" in said
