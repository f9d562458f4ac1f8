"""A scripted team as a ROS graph: what it does in one process."""

from __future__ import annotations

from pathlib import Path

import pytest

from crash_coach_bringup.ros.evaluation import evaluate_via_ros
from policy_pkg.play.conditions import exactly
from policy_pkg.play.evaluate import Scripted, evaluate


@pytest.mark.parametrize("layout", ["single", pytest.param("nodes", marks=pytest.mark.soak)])
def test_the_same_episodes(tmp_path: Path, layout: str) -> None:
    condition = exactly(1, "random")
    core = evaluate(Scripted("random"), "buttons", condition, 2, 3)
    ros = evaluate_via_ros(
        Path("scripted:random"), "buttons", condition, 2, 3,
        layout="nodes" if layout == "nodes" else "single", log_dir=tmp_path,
    )  # fmt: skip
    assert ros.summary()["trajectory_hash"] == core.summary()["trajectory_hash"]
