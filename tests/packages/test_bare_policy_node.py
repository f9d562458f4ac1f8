"""A policy node in an environment of its own: ROS, numpy and what docs/export.md names, no more."""

from __future__ import annotations

import re
from pathlib import Path

import bare_environment
import pytest

from crash_coach_bringup.ros import graph
from crash_coach_bringup.ros.evaluation import evaluate_via_ros
from policy_pkg.checkpoint import load_policy
from policy_pkg.export.export import Format, export
from policy_pkg.play.conditions import named
from policy_pkg.play.evaluate import evaluate

ROOT = Path(__file__).resolve().parents[2]
TEAM = ROOT / "results/recipe/robust/robust-s0"
PAGE = ROOT / "docs/export.md"
ABSENT = ("torch", "numba", "pymunk", "sim_pkg", "crash_coach_pkg", "onnx")

pytestmark = bare_environment.needs_wheels


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A virtual environment with ROS's wheels and policy_pkg[acting], as pip installs it."""
    ours = {"ros_ws/src/crash_coach_common": "", "policy_pkg": "[acting]"}
    return bare_environment.make(tmp_path_factory.mktemp("bare"), ours)


def test_nothing_else_is_there(bare: Path) -> None:
    present = ["numpy", "safetensors", "policy_pkg"]
    assert bare_environment.found(bare, *ABSENT, *present) == present


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
        return bare_environment.program(bare, name, tmp_path)

    monkeypatch.setattr(graph, "find_executable", find)
    condition = named(("robot_2",), "mute")
    expected = evaluate(bundle, "buttons", condition, 3, 5, effects=True)
    got = evaluate_via_ros(tmp_path / "exported", "buttons", condition, 3, 5, "nodes")
    assert got == expected
    assert started == ["policy", "policy"]
