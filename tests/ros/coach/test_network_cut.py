"""A real network failure: sim and gate on one host, a policy on another, the link cut and mended.

The hosts are network namespaces joined by a veth pair; see network_cut.py.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from network_cut import CMD_TIMEOUT_S, FAR, NEAR, NOT_PERMITTED, PERIOD_S

LIMIT_S = 90.0
UNSHARE = ("unshare", "--map-root-user", "--net")
DIAGNOSTICS_S = 1.0
SLACK_S = 0.5  # a loaded machine


def refuse_without_namespaces() -> None:
    for tool in ("unshare", "nsenter", "ip"):
        if shutil.which(tool) is None:
            pytest.skip(f"no {tool} (util-linux, iproute2) on this machine")
    tried = subprocess.run([*UNSHARE, "true"], capture_output=True, text=True, timeout=10)
    if tried.returncode != 0:
        pytest.skip(f"network namespaces are not permitted here: {tried.stderr.strip()}")


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    refuse_without_namespaces()
    folder = tmp_path_factory.mktemp("network")
    script = str(Path(__file__).parents[2] / "support" / "network_cut.py")
    # --kill-child, and what dies with its parent: nothing is left, even where this is killed.
    done = subprocess.run(
        [*UNSHARE, "--fork", "--kill-child", sys.executable, script, str(folder)],
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
    )
    if done.returncode == NOT_PERMITTED:
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, done.stderr  # a dead process, or a wait that ended in vain
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def test_the_robot_behind_the_link_stops_in_time(seen: dict[str, Any]) -> None:
    assert seen["stopped_s"] <= CMD_TIMEOUT_S + PERIOD_S + SLACK_S


def test_sim_and_gate_report_it_lost_not_muted(seen: dict[str, Any]) -> None:
    for who in ("sim", "gate"):
        assert seen[f"{who}_lost_s"] <= CMD_TIMEOUT_S + 2 * DIAGNOSTICS_S + SLACK_S
    assert "muted" not in json.dumps(seen["said"])
    assert not seen["crashed"]


def test_the_other_robot_goes_on(seen: dict[str, Any]) -> None:
    assert seen["near_moves_s"] > max(seen["sim_lost_s"], seen["gate_lost_s"]) - PERIOD_S - SLACK_S
    assert [text for who, text in seen["said"] if NEAR in who] == ["ok", "ok"]
    assert FAR in str(seen["said"])


def test_it_resumes_when_the_link_is_back(seen: dict[str, Any]) -> None:
    assert seen["moving_s"] <= 5.0
