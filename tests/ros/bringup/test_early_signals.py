"""A signal while an executable still loads ends it without a word."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from importlib.metadata import entry_points
from pathlib import Path

import pytest

SLOW = """
import time
from pathlib import Path
Path("loading").touch()
time.sleep(30)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_at_once_and_says_nothing(tmp_path: Path, number: signal.Signals) -> None:
    (tmp_path / "slow.py").write_text(SLOW)
    child = subprocess.Popen(
        [sys.executable, "-m", "crash_coach_common.executable", "slow"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        end_s = time.monotonic() + 20
        while not (tmp_path / "loading").exists():
            assert time.monotonic() < end_s
            time.sleep(0.02)
        child.send_signal(number)
        said, _ = child.communicate(timeout=5)
    finally:
        child.kill()
    assert (child.returncode, said) == (0, "")


def test_every_node_starts_so() -> None:
    ours = [
        script
        for script in entry_points(group="console_scripts")
        if script.module.startswith(("sim_pkg.", "policy_pkg.", "crash_coach_pkg."))
    ]
    assert {script.name for script in ours} == {
        "sim", "policy", "team", "recorder", "trainer", "coach", "gate",
    }  # fmt: skip
    assert all(script.module.endswith("_pkg.executables") for script in ours)
