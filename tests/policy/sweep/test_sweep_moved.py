"""A sweep whose folder is moved and worked on from elsewhere ends as it would have."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path
from typing import Any

import pytest
from in_process import typed
from report_cases import results_of
from sweep_cases import assert_same_results, tiny_runs, train_alone

from policy_pkg.sweep.config import SweepRun, load_sweep
from policy_pkg.sweep.task import Task
from policy_pkg.sweep.worker import perform
from policy_pkg.train.run import EndedEarly, train
from sim_pkg.scenario_files import find_scenario


def work(runs: list[SweepRun], out: Path) -> None:
    """What a sweep's processes do, each with a run, in this one."""
    for run in runs:
        name, config, at = run.name, run.config, str(out.resolve())
        task = {"name": name, "config": config, "out": at, "cwd": str(Path.cwd())}
        perform(Task.model_validate({**task, "command": ["sweep"], "lock_wait_s": 1.0}))


def reported(runs: str, out: str) -> Any:
    done = typed("report", runs, "--out", out, "--episodes", "4", "--crashed", "0", "1")
    assert done.returncode == 0, done.stderr
    results: Any = results_of(Path(out))
    for run in results["runs"]:
        del run["run"], run["wall_s"]  # where it lies now, and how long it took
    return results


def test_a_sweep_that_was_moved_goes_on_and_reports_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, there = tmp_path / "here", tmp_path / "far" / "there"
    here.mkdir()
    monkeypatch.chdir(here)
    shutil.copy(find_scenario("buttons"), "hall.yaml")
    runs = tiny_runs(Path(), scenarios=["hall.yaml"], total_steps=800)
    train_alone(runs, tmp_path / "alone")
    expected = reported(str(tmp_path / "alone/hall"), "expected")

    out, (first, second) = Path("out"), runs
    work([first], out)
    steps = itertools.count()
    with pytest.raises(EndedEarly):
        train(second.config, out / second.name, stopped=lambda: next(steps) == 100)
    there.parent.mkdir()
    here.rename(there)
    monkeypatch.chdir(there)
    listed = typed("sweep", "sweep.yaml", "--out", "out", "--dry-run")
    assert "1 finished (0 of them elsewhere), 1 to continue, 0 new" in listed.stdout
    work(load_sweep(Path("sweep.yaml")), out)
    assert_same_results(runs, out, tmp_path / "alone")
    assert reported("out/hall", "moved") == expected
    monkeypatch.chdir(tmp_path)
    assert reported("far/there/out/hall", "again") == expected
