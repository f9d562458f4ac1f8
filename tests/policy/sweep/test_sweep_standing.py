"""How far a sweep's runs are, told from their folders; locks; what a sweep does with engines."""

from __future__ import annotations

import importlib
import sys
import threading
import time
from pathlib import Path

import pytest
from sweep_cases import tiny_runs

from policy_pkg.checkpoint import CHECKPOINTS
from policy_pkg.sweep.config import SweepRun
from policy_pkg.sweep.folder import (
    RunFiles,
    RunProgress,
    check_mark,
    exclusive,
    leave_mark,
    read_progress,
    standing,
    write_progress,
)
from policy_pkg.sweep.sweep import Ended, Event, Snapshot, Sweep
from policy_pkg.sweep.task import Task
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.run_dir import RunError, prepare_run


def write_run(folder: Path, config: TrainConfig, steps: int) -> None:
    """A run folder as training leaves it at ``steps``, as far as a sweep looks."""
    prepare_run(folder, config, resume=True)
    (folder / CHECKPOINTS / f"step_{steps:09d}").mkdir(parents=True)


@pytest.fixture
def run(tmp_path: Path) -> SweepRun:
    return tiny_runs(tmp_path)[0]


def test_a_run_goes_from_new_to_finished(run: SweepRun, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert (standing(run, out).kind, standing(run, out).steps) == ("new", 0)
    prepare_run(out / run.name, run.config, resume=False)
    assert (standing(run, out).kind, standing(run, out).steps) == ("started", 0)
    write_run(out / run.name, run.config, 400)
    assert (standing(run, out).kind, standing(run, out).steps) == ("started", 400)
    write_run(out / run.name, run.config, 2000)
    assert standing(run, out).done


def test_a_folder_of_another_configuration_is_refused(run: SweepRun, tmp_path: Path) -> None:
    other = run.config.model_copy(update={"n_envs": 6})
    write_run(tmp_path / "out" / run.name, other, 2000)
    with pytest.raises(RunError, match=r"buttons/qmix-s0 was started with n_envs = 6, not 5"):
        Sweep([run], tmp_path / "out")


@pytest.mark.parametrize("place", ["buttons/qmix-s0", "qmix-s0"])
def test_a_finished_run_elsewhere_counts(run: SweepRun, tmp_path: Path, place: str) -> None:
    kept = tmp_path / "results"
    shorter = run.config.model_copy(
        update={"loggers": {"tensorboard": True}, "checkpoint_replay": False}
    )
    write_run(kept / place, shorter, 2000)
    found = standing(run, tmp_path / "out", [tmp_path, kept])
    assert (found.kind, found.path) == ("kept", kept / place)


@pytest.mark.parametrize(
    ("changes", "steps", "remark"),
    [
        ({}, 1600, "is not finished: 1,600 of 2,000 steps"),
        ({"n_envs": 6}, 2000, "was started with n_envs = 6, not 5"),
        ({"scenario": "buttons_8"}, 2000, "was started with scenario = 'buttons_8'"),
    ],
)
def test_another_run_elsewhere_does_not_count(
    run: SweepRun, tmp_path: Path, changes: dict[str, int], steps: int, remark: str
) -> None:
    kept = tmp_path / "results"
    write_run(kept / "qmix-s0", run.config.model_copy(update=changes), steps)
    found = standing(run, tmp_path / "out", [kept])
    assert found.kind == "new"
    assert remark in (found.remark or "")


def test_a_lock_is_waited_for_so_long_and_no_longer(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "lock"
    with exclusive(path, 0.0, "it is held"):
        began = time.monotonic()
        with (
            pytest.raises(RunError, match=r"it is held by another process \(process \d+ on .+\)"),
            exclusive(path, 0.5, "it is held"),
        ):
            pass
        assert 0.5 <= time.monotonic() - began < 5
    waited = []
    held = threading.Event()

    def hold() -> None:
        with exclusive(path, 0.0, "it is held"):
            held.set()
            time.sleep(0.5)

    holder = threading.Thread(target=hold)
    holder.start()
    assert held.wait(10)
    with exclusive(path, 30.0, "it is held", lambda: waited.append(True)):
        assert waited == [True]
    holder.join()


def test_a_machine_that_sees_another_folder_is_told(tmp_path: Path) -> None:
    mark = leave_mark(tmp_path)
    check_mark(str(tmp_path), mark)
    with pytest.raises(RunError, match=r"it does not see .*mark: No such file"):
        check_mark(str(tmp_path / "elsewhere"), mark)
    leave_mark(tmp_path)
    with pytest.raises(RunError, match=r"its .*mark is another file"):
        check_mark(str(tmp_path), mark)


def test_without_ray_it_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.delitem(sys.modules, "policy_pkg.sweep.ray_engine", raising=False)
    with pytest.raises(RunError, match=r"--engine ray needs the extra package ray: .*make ray"):
        importlib.import_module("policy_pkg.sweep.ray_engine")


def test_progress_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "x.progress"
    assert read_progress(path) is None
    told = RunProgress(5, 10, 2.5, 0.1, None, "the disk is full")
    write_progress(path, told)
    assert read_progress(path) == told
    path.write_text('{"env_steps": 3}')
    with pytest.raises(RunError, match=r"x\.progress cannot be read"):
        read_progress(path)


class Scripted:
    """An engine by which each run ends at the steps that it was given; None: it fails."""

    def __init__(self, slots: int, ends: dict[str, int | None]) -> None:
        self.slots = slots
        self.ends = ends
        self.running: list[Task] = []
        self.most = 0
        self.stopped = False

    def start(self, task: Task) -> None:
        self.running.append(task)
        self.most = max(self.most, len(self.running))
        files = RunFiles(Path(task.out), task.name)
        write_progress(files.progress, RunProgress(1, 2000, 10.0, 0.0, None))

    def poll(self) -> list[Ended]:
        if not self.running:
            return []
        task = self.running.pop(0)
        end = self.ends[task.name]
        if end is not None:
            write_run(Path(task.out) / task.name, task.config, end)
        return [Ended(task.name, "it burned down" if end is None else None)]

    def stop(self) -> None:
        self.stopped = True


def test_a_sweep_does_what_is_left_and_tells(tmp_path: Path) -> None:
    runs = tiny_runs(tmp_path, seeds=[0, 1])
    out = tmp_path / "out"
    write_run(out / runs[0].name, runs[0].config, 2000)
    ends = {runs[1].name: 2000, runs[2].name: None, runs[3].name: 1600}
    engine = Scripted(2, ends)
    events: list[Event] = []
    snapshots: list[Snapshot] = []
    sweep = Sweep(runs, out)
    sweep.work(engine, events.append, snapshots.append)
    assert engine.stopped
    assert engine.most == 2
    kinds = [(event.kind, event.name) for event in events]
    assert {name for kind, name in kinds if kind == "started"} == set(ends)
    assert [name for kind, name in kinds if kind == "finished"] == [runs[1].name]
    assert sweep.failed == {
        runs[2].name: "it burned down",
        runs[3].name: "it ended at 1,600 steps without a word",
    }
    first = snapshots[0]
    assert (first.runs, first.done, first.waiting, len(first.running)) == (4, 1, 1, 2)
    assert (first.steps_left, first.steps_per_s) == (2 * 1999 + 2000, 20.0)
    again = Scripted(2, {runs[2].name: 2000, runs[3].name: 2000})
    Sweep(runs, out).work(again)
    assert not Sweep(runs, out).left


def test_a_second_sweep_in_the_same_folder_is_refused(run: SweepRun, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with (
        exclusive(out / ".sweep" / "lock", 0.0, ""),
        pytest.raises(RunError, match=r"out is being worked on by another process \(process \d+"),
    ):
        Sweep([run], out).work(Scripted(1, {}))


def test_a_stopped_sweep_stops_its_engine(run: SweepRun, tmp_path: Path) -> None:
    engine = Scripted(1, {run.name: 2000})
    sweep = Sweep([run], tmp_path / "out")
    sweep.work(engine, stopped=lambda: True)
    assert engine.stopped
    assert sweep.left == 1
