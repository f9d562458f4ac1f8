"""A policy node in an environment of its own: ROS, numpy and what docs/export.md names, no more."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from crash_coach_bringup.ros import graph
from crash_coach_bringup.ros.evaluation import evaluate_via_ros
from policy_pkg.checkpoint import load_policy
from policy_pkg.export.export import Format, export
from policy_pkg.play.conditions import named
from policy_pkg.play.evaluate import evaluate

ROOT = Path(__file__).resolve().parents[3]
INTERFACES = ROOT / "ros_ws/install/crash_coach_interfaces"
TEAM = ROOT / "results/recipe/robust_openblas/robust-s0"
PAGE = ROOT / "docs/export.md"
ROS = ("ros-jazzy-rclpy", "ros-jazzy-rmw-fastrtps-cpp", "ros-jazzy-std-msgs")
ABSENT = ("torch", "numba", "pymunk", "sim_pkg", "crash_coach_pkg", "onnx")

pytestmark = pytest.mark.skipif(
    os.environ.get("ROS_DISTRO") == "jazzy",
    reason="the bare environment is made of ROS's wheels; here a distribution is sourced",
)


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A virtual environment with ROS's wheels and policy_pkg[acting], as pip installs it."""
    folder = tmp_path_factory.mktemp("bare")
    venv, uv, own = folder / "venv", ROOT / ".venv/bin/uv", ROOT / ".venv/bin/python"
    subprocess.run([uv, "venv", "--quiet", "--python", own, venv], check=True, timeout=60)
    for package in ("ros_ws/src/crash_coach_common", "policy_pkg"):  # pip builds in its source
        shutil.copytree(ROOT / package, folder / Path(package).name)
    packages = [folder / "crash_coach_common", f"{folder / 'policy_pkg'}[acting]"]
    lock = ROOT / "requirements.lock"  # the set-up's own versions: they lie in uv's cache
    command = [uv, "pip", "install", "--quiet", "--python", venv / "bin/python", "-c", lock]
    subprocess.run(
        [*command, "--build-constraints", lock, *ROS, *packages], check=True, timeout=300
    )
    return venv


def program(bare: Path, name: str, folder: Path) -> Path:
    """An executable of the bare environment that takes nothing over from this one's."""
    (python,) = (INTERFACES / "lib").glob("python3*/site-packages")
    env = {
        "PATH": "/usr/bin:/bin",
        "PYTHONPATH": str(python),
        "LD_LIBRARY_PATH": str(INTERFACES / "lib"),
        "AMENT_PREFIX_PATH": f"{bare}:{INTERFACES}",
        "HOME": str(folder),
    }
    kept = ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE")
    values = [f"{key}={shlex.quote(value)}" for key, value in env.items()]
    values += [f'{key}="${key}"' for key in kept]
    path = folder / name
    path.write_text(f'#!/bin/sh\nexec env -i {" ".join(values)} {bare / "bin" / name} "$@"\n')
    path.chmod(0o755)
    return path


def test_nothing_else_is_there(bare: Path) -> None:
    code = "import importlib.util as u, sys; print([n for n in sys.argv[1:] if u.find_spec(n)])"
    command = [bare / "bin/python", "-I", "-c", code, *ABSENT, "numpy", "safetensors", "policy_pkg"]
    said = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
    assert said == "['numpy', 'safetensors', 'policy_pkg']\n"


def test_its_size_is_what_the_page_says(bare: Path) -> None:
    megabytes = sum(p.lstat().st_size for p in bare.rglob("*") if p.is_file()) / 1e6
    (said,) = re.findall(r"(\d+) MB in all", PAGE.read_text())
    assert megabytes == pytest.approx(float(said), rel=0.1)


def test_it_acts_as_the_team_does_everywhere(
    bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A whole graph in lock-step with a robot muted: bit for bit the evaluation without ROS."""
    bundle = load_policy(TEAM)
    export(bundle, None, Format.safetensors, tmp_path / "exported")
    own = graph.find_executable
    started: list[str] = []

    def find(package: str, name: str) -> Path:
        if package != "policy_pkg":
            return own(package, name)
        started.append(name)
        return program(bare, name, tmp_path)

    monkeypatch.setattr(graph, "find_executable", find)
    condition = named(("robot_2",), "mute")
    expected = evaluate(bundle, "buttons", condition, 3, 5, effects=True)
    got = evaluate_via_ros(tmp_path / "exported", "buttons", condition, 3, 5, "nodes")
    assert got == expected
    assert started == ["policy", "policy"]
