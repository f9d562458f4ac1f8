"""Ctrl-C while spawned processes still load."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

CODE = """
import multiprocessing, sys
import slow
from crash_coach_common.spawned import start_deaf

if __name__ == "__main__":
    process = multiprocessing.get_context("spawn").Process(target=slow.work)
    start_deaf(process)
    print(process.pid, flush=True)
    process.join()
    sys.exit(process.exitcode)
"""
SLOW = """
import pathlib, signal, sys, time
from crash_coach_common.spawned import hear

HERE = pathlib.Path(__file__).parent
if "--multiprocessing-fork" in sys.orig_argv:
    (HERE / "loading").touch()
    while not (HERE / "go").exists():
        time.sleep(0.01)

def work():
    signal.signal(signal.SIGINT, lambda *_: sys.exit(7))
    hear()
    time.sleep(60)
    sys.exit(8)
"""


@pytest.mark.parametrize("when", ["loading", "loaded"])
def test_it_waits_until_they_have_loaded_and_is_not_lost(tmp_path: Path, when: str) -> None:
    (tmp_path / "slow.py").write_text(SLOW)
    (tmp_path / "main.py").write_text(CODE)
    if when == "loaded":
        (tmp_path / "go").touch()
    with subprocess.Popen(
        [sys.executable, "main.py"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as child:
        assert child.stdout is not None
        pid = int(child.stdout.readline())
        deadline_s = time.monotonic() + 60
        while not (tmp_path / "loading").exists():
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
        if when == "loaded":
            time.sleep(0.3)
        os.kill(pid, signal.SIGINT)
        if when == "loading":
            time.sleep(0.2)
            assert child.poll() is None
            (tmp_path / "go").touch()
        _, errors = child.communicate(timeout=60)
    assert (child.returncode, errors) == (7, "")
