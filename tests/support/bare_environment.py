"""Virtual environments of ROS's wheels and some of our packages alone, as pip makes them."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
INTERFACES = ROOT / "ros_ws/install/crash_coach_interfaces"
ROS = ("ros-jazzy-rclpy", "ros-jazzy-rmw-fastrtps-cpp", "ros-jazzy-std-msgs")
KEPT = ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE")

needs_wheels = pytest.mark.skipif(
    os.environ.get("ROS_DISTRO") == "jazzy",
    reason="the bare environment is made of ROS's wheels; here a distribution is sourced",
)


def make(folder: Path, ours: dict[str, str], *more: str) -> Path:
    """The environment.

    ours: the packages' folders in the repository, and the extra of each, as "[acting]".
    more: further packages, in the set-up's own versions, which lie in uv's cache.
    """
    venv, uv, own = folder / "venv", ROOT / ".venv/bin/uv", ROOT / ".venv/bin/python"
    subprocess.run([uv, "venv", "--quiet", "--python", own, venv], check=True, timeout=100)
    for package in ours:  # pip builds in its source
        shutil.copytree(ROOT / package, folder / Path(package).name)
    packages = [f"{folder / Path(package).name}{extra}" for package, extra in ours.items()]
    lock = ROOT / "requirements.lock"
    command = [uv, "pip", "install", "--quiet", "--python", venv / "bin/python", "-c", lock]
    options = ["--build-constraints", lock]
    subprocess.run([*command, *options, *ROS, *more, *packages], check=True, timeout=300)
    return venv


def found(venv: Path, *modules: str) -> list[str]:
    """Those of the modules that are there."""
    code = "import importlib.util as u, sys; print(*(n for n in sys.argv[1:] if u.find_spec(n)))"
    command = [venv / "bin/python", "-I", "-c", code, *modules]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    return done.stdout.split()


def program(venv: Path, name: str, folder: Path) -> Path:
    """An executable of the environment, in ``folder``, that takes nothing over from this one's."""
    (python,) = (INTERFACES / "lib").glob("python3*/site-packages")
    env = {
        "PATH": "/usr/bin:/bin",
        "PYTHONPATH": str(python),
        "LD_LIBRARY_PATH": str(INTERFACES / "lib"),
        "AMENT_PREFIX_PATH": f"{venv}:{INTERFACES}",
        "HOME": str(folder),
    }
    values = [f"{key}={shlex.quote(value)}" for key, value in env.items()]
    values += [f'{key}="${key}"' for key in KEPT]
    path = folder / name
    path.write_text(f'#!/bin/sh\nexec env -i {" ".join(values)} {venv / "bin" / name} "$@"\n')
    path.chmod(0o755)
    return path
