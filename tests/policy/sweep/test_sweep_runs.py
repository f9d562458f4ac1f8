"""Sweeps that train: killed, stopped, with a failing run, on a cluster that loses a node."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from sweep_cases import (
    TINY,
    assert_same_results,
    processes_of,
    tiny_runs,
    train_alone,
    write_sweep,
)

from policy_pkg.checkpoint import CHECKPOINTS, find_checkpoint, load_policy
from policy_pkg.report.finished_runs import read_runs
from policy_pkg.sweep.config import SweepRun
from policy_pkg.sweep.folder import RunFiles, exclusive
from policy_pkg.sweep.local_engine import LocalEngine
from policy_pkg.sweep.sweep import Sweep
from policy_pkg.train.run_dir import newest_step, read_run

COMMAND = [sys.executable, "-m", "crash_coach_bringup.cli.main", "sweep"]


def start(sweep: Path, out: Path, *options: str) -> subprocess.Popen[str]:
    """The command in a process group of its own, as a shell starts it."""
    command = [*COMMAND, str(sweep), "--out", str(out), "--processes", "2", *options]
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        env={**os.environ, "COLUMNS": "300"},
    )


def wait_for(condition: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    """Until it holds, while the process runs."""
    deadline = time.monotonic() + 100
    while not condition():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.01)


def kill(process: subprocess.Popen[str], out: Path) -> None:
    """SIGKILL to the whole process group; what it started must not run on."""
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate(timeout=100)
    deadline = time.monotonic() + 20
    while processes_of(out):
        assert time.monotonic() < deadline, f"{processes_of(out)} run on unseen"
        time.sleep(0.02)


def steps(runs: list[SweepRun], out: Path) -> int:
    return sum(newest_step(out / run.name) for run in runs)


@pytest.mark.soak
@pytest.mark.timeout(300)
def test_a_killed_sweep_ends_with_the_same_results(tmp_path: Path) -> None:
    adaptive = {"adaptive": TINY["methods"]["adaptive"]}
    runs, out = tiny_runs(tmp_path, methods=adaptive), tmp_path / "out"
    train_alone(runs, tmp_path / "alone")
    process = start(tmp_path / "sweep.yaml", out)
    wait_for(lambda: steps(runs, out) > 0, process)
    kill(process, out)
    done = start(tmp_path / "sweep.yaml", out)
    assert "all 1 runs are finished" in done.communicate(timeout=250)[0]
    assert done.returncode == 0
    assert_same_results(runs, out, tmp_path / "alone")
    before = {p: p.stat().st_mtime_ns for p in (out / "buttons").rglob("*")}
    again = start(tmp_path / "sweep.yaml", out)
    assert "1 finished (0 of them elsewhere), 0 to continue, 0 new" in again.communicate()[0]
    assert {p: p.stat().st_mtime_ns for p in (out / "buttons").rglob("*")} == before


@pytest.mark.soak
def test_killed_ten_times_at_random_moments(tmp_path: Path) -> None:
    """Most of them while it trains, some while it starts."""
    chance = random.Random(7)
    runs = tiny_runs(tmp_path, total_steps=50_000, seeds=[0, 1])
    out = tmp_path / "out"
    train_alone(runs, tmp_path / "alone")
    told = [RunFiles(out, run.name).progress for run in runs]
    reached = []
    for _ in range(10):
        process = start(tmp_path / "sweep.yaml", out)
        if chance.random() < 0.7:
            since_s = time.time()
            wait_for(
                lambda since_s=since_s: any(  # type: ignore[misc]
                    path.exists() and path.stat().st_mtime > since_s for path in told
                ),
                process,
            )
        time.sleep(chance.uniform(0, 4))
        assert process.poll() is None, "the sweep is too short for ten kills"
        kill(process, out)
        reached.append(steps(runs, out))
    assert reached == sorted(reached)
    assert len(set(reached)) >= 4, "hardly a kill came while it trained"
    done = start(tmp_path / "sweep.yaml", out)
    assert "all 4 runs are finished" in done.communicate(timeout=600)[0]
    assert_same_results(runs, out, tmp_path / "alone")


def test_a_failing_run_is_told_and_the_other_goes_on(tmp_path: Path) -> None:
    """It fails because another process holds its lock for too long."""
    runs, out = tiny_runs(tmp_path, total_steps=600), tmp_path / "out"
    bad, good = runs
    sweep = Sweep(runs, out, command=["crash-coach", "sweep", "mine.yaml"], lock_wait_s=0.5)
    with exclusive(RunFiles(out, bad.name).lock, 0.0, ""):
        sweep.work(LocalEngine(2))
    assert list(sweep.failed) == [bad.name]
    assert f"{out / bad.name} is being trained by another process" in sweep.failed[bad.name]
    assert str(RunFiles(out, bad.name).log) in sweep.failed[bad.name]
    assert not (out / bad.name).exists()
    # What a finished run leaves is a run as any other, without the replay.
    assert sweep.standings[good.name].done
    folder = out / good.name
    assert not list(folder.rglob("replay.safetensors"))
    assert len(list((folder / CHECKPOINTS).iterdir())) == 1
    assert load_policy(folder).path == find_checkpoint(folder)
    (found,) = read_runs([folder])
    assert (found.method, found.finished) == ("adaptive", True)
    assert read_run(folder)["command"] == ["crash-coach", "sweep", "mine.yaml"]


@pytest.mark.soak
def test_a_foreign_folder_fails_alone(tmp_path: Path) -> None:
    runs, out = tiny_runs(tmp_path, total_steps=600), tmp_path / "out"
    foreign = out / runs[0].name / "notes.txt"
    foreign.parent.mkdir(parents=True)
    foreign.write_text("mine")
    process = start(tmp_path / "sweep.yaml", out)
    output = process.communicate(timeout=250)[0]
    assert process.returncode == 1
    assert "qmix-s0 is not empty and holds no run" in output
    assert "1 of 2 runs failed; mend them, then crash-coach sweep" in output
    assert "Traceback" not in output
    assert newest_step(out / runs[1].name) == 600
    assert foreign.read_text() == "mine"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.soak
def test_a_stopped_sweep_says_how_to_go_on(tmp_path: Path, number: signal.Signals) -> None:
    path = write_sweep(tmp_path / "sweep.yaml", total_steps=200_000)
    process = start(path, tmp_path / "out")
    wait_for(lambda: len(processes_of(tmp_path / "out")) >= 3, process)
    os.killpg(process.pid, number)
    output = process.communicate(timeout=100)[0]
    assert process.returncode == 128 + number
    assert "stopped; 2 of 2 runs are left" in output
    assert "Traceback" not in output
    assert not processes_of(tmp_path / "out")
