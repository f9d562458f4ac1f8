"""A checkout that is mounted read-only, and a home that cannot be written: everything works.

Permissions do not bind root, a mount does: in a user namespace of the test's own.
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_common.caches import FOLDERS
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

ROOT = Path(__file__).resolve().parents[2]
MOUNT = 'mount --rbind "$1" "$1" && mount -o remount,bind,ro "$1"'
COMMAND = str(ROOT / ".venv" / "bin" / "crash-coach")


def mounted(*words: str) -> list[str]:
    """A command for which the checkout is read-only."""
    script = f'{MOUNT} && shift && exec "$@"'
    return ["unshare", "--map-root-user", "--mount", "bash", "-c", script, "-", str(ROOT), *words]


def why_not() -> str:
    """Why this machine cannot mount it so; '' where it can."""
    try:
        tried = subprocess.run(
            mounted("touch", str(ROOT / "written")), capture_output=True, text=True, timeout=30
        )
    except FileNotFoundError:
        return "unshare is not installed"
    said = tried.stderr.strip()
    return "" if "Read-only file system" in said else f"no user namespaces with mounts: {said}"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """Where one works, with a team in it; nothing else can be written."""
    if reason := why_not():
        pytest.skip(reason)
    write_untrained(tmp_path / "step_0", make_env("buttons", 1).spec, seed=1)
    (tmp_path / "tmp").mkdir()
    return tmp_path


def typed(place: Path, *words: str, timeout_s: float = 110) -> subprocess.CompletedProcess[str]:
    kept = {*FOLDERS, "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "ROS_HOME", "PYTHONDONTWRITEBYTECODE"}
    env = {name: value for name, value in os.environ.items() if name not in kept}
    env |= {"HOME": str(ROOT / "docs"), "TMPDIR": str(place / "tmp")}
    with reserve_domain() as domain:
        env["ROS_DOMAIN_ID"] = str(domain)
        return subprocess.run(
            mounted(COMMAND, *words),
            cwd=place, env=env, capture_output=True, text=True, timeout=timeout_s, check=False,
        )  # fmt: skip


def only_the_caches_are_told(place: Path, said: str) -> None:
    base = place / "tmp" / f"crash_coach_{os.getuid()}"
    assert said == f"crash-coach: no home to write to: caches and logs in {base}\n"


def test_a_team_is_evaluated(place: Path) -> None:
    done = typed(place, "evaluate", "step_0", "--episodes", "1", "--json", "out.json")
    assert done.returncode == 0, done.stderr
    only_the_caches_are_told(place, done.stderr)
    assert json.loads((place / "out.json").read_text())


@pytest.mark.soak  # three processes compile without a cache
def test_a_graph_runs(place: Path) -> None:
    done = typed(place, "up", "buttons", "--policy", "step_0", "--episodes", "1")
    assert done.returncode == 0, done.stdout + done.stderr
    only_the_caches_are_told(place, done.stderr)
    logs = {path.name: path.read_text() for path in (place / "runs" / "up").glob("*.log")}
    assert {"sim.log", "gate.log", "coach.log"} <= set(logs)
    assert not [text for text in logs.values() if "Traceback" in text or "rror" in text]


@pytest.mark.soak  # all that a training compiles, without a cache
def test_a_team_is_trained(place: Path) -> None:
    size = ("total_steps=200", "test_interval_steps=100", "test_episodes=2")
    done = typed(place, "train", "buttons/qmix", "--out", "run", "--set", *size, timeout_s=900)
    assert done.returncode == 0, done.stdout + done.stderr
    only_the_caches_are_told(place, done.stderr)
    assert list((place / "run").glob("**/step_*"))
