"""2N steps = N + kill + resume: the same weights and the same metrics, bit for bit."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from crash_coach_common.contract import UserError
from policy_pkg.checkpoint import (
    BEST,
    CheckpointError,
    find_checkpoint,
    list_checkpoints,
    read_manifest,
    read_tensors,
)
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.progress import Phase, ProgressReport
from policy_pkg.train.run import train

CONFIG = TrainConfig.model_validate(
    {
        "scenario": "buttons",
        "seed": 3,
        "total_steps": 2400,
        "n_envs": 5,
        "updates_per_episode": 0.7,
        "batch_episodes": 4,
        "replay_episodes": 30,
        "epsilon_anneal_steps": 1000,
        "test_interval_steps": 200,
        "test_episodes": 6,
        "checkpoint_interval_steps": 400,
        "loggers": {"tensorboard": False},
        "learner": {
            "hidden": 16,
            "mixing_hidden": 8,
            "hypernet_hidden": 8,
            "target_update_interval_episodes": 20,
        },
        "coach": {
            "strategy": "adaptive",
            "adaptive": {"rho": 0.3, "beta": 0.0},
            "crash_mode": "random",
        },
    }
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("whole") / "run"
    train(CONFIG, run)
    return run


def assert_same_run(run: Path, other: Path) -> None:
    assert (run / "metrics.jsonl").read_bytes() == (other / "metrics.jsonl").read_bytes()
    folders = find_checkpoint(run), find_checkpoint(other)
    one, two = (read_manifest(folder) for folder in folders)
    assert one.progress == two.progress
    assert set(one.files) == {"agent", "learner", "replay", "rollout"}
    for stem in one.files:
        mine, theirs = (read_tensors(f, m, stem) for f, m in zip(folders, (one, two), strict=True))
        assert set(mine) == set(theirs)
        for name, array in mine.items():
            np.testing.assert_array_equal(array, theirs[name], err_msg=f"{stem}: {name}")
    training = [dict(m.training) for m in (one, two)]
    for values in training:
        values["logged"] = {k: v for k, v in values["logged"].items() if k != "timing_bytes"}
    assert training[0] == training[1]


class Stopped(Exception):
    pass


def train_until(config: TrainConfig, run: Path, there: Callable[[ProgressReport], bool]) -> None:
    """Trains, and is killed by surprise as soon as a report is ``there``."""

    def stop(report: ProgressReport) -> None:
        if there(report):
            raise Stopped

    ticks = iter(range(10**9))  # a clock on which every step is worth a report
    with pytest.raises(Stopped):
        train(config, run, progress=stop, clock=lambda: float(next(ticks)))


@pytest.mark.parametrize(
    ("phase", "steps"),
    [("evaluation", 200), ("evaluation", 1000), ("checkpoint", 1200), ("training", 1705)],
)
def test_stopping_anywhere_and_resuming_changes_no_bit(
    whole: Path, tmp_path: Path, phase: Phase, steps: int
) -> None:
    run = tmp_path / "run"
    train_until(CONFIG, run, lambda report: report.phase == phase and report.steps >= steps)
    train(CONFIG, run, resume=True)
    assert_same_run(run, whole)


def test_faults_with_memory_go_on_where_they_were(tmp_path: Path) -> None:
    """Commands under way in a delay, and a hazard between two strikes."""
    coach = {
        "strategy": "fixed",
        "crash_mode": "delay",
        "crash_parameters": {"steps": 2},
        "hazard_rate_hz": 0.5,
        "duration_steps": 5,
        "min_alive": 1,
    }
    settings = {**CONFIG.model_dump(), "total_steps": 800, "coach": coach}
    config = TrainConfig.model_validate(settings)
    train(config, tmp_path / "whole")

    train_until(config, tmp_path / "run", lambda report: report.steps >= 600)
    assert read_manifest(find_checkpoint(tmp_path / "run")).progress["env_steps"] == 400
    train(config, tmp_path / "run", resume=True)
    assert_same_run(tmp_path / "run", tmp_path / "whole")
    replay = read_tensors(
        find_checkpoint(tmp_path / "run"),
        read_manifest(find_checkpoint(tmp_path / "run")),
        "replay",
    )
    assert 4 in replay["faults"]


@pytest.mark.parametrize("strategy", ["curriculum", "patient", "deck", "learnability", "failure"])
def test_a_strategys_state_goes_on_where_it_was(tmp_path: Path, strategy: str) -> None:
    """Killed by surprise between two checkpoints, with episodes under way."""
    coach = {
        "strategy": strategy,
        "crash_mode": "random",
        "min_alive": 1,
        "crash_rate": 0.5,
        "patient": {"success": 0.0},  # it begins with the first block
    }
    settings = {**CONFIG.model_dump(), "total_steps": 1200, "coach": coach}
    config = TrainConfig.model_validate(settings)
    train(config, tmp_path / "whole")

    train_until(config, tmp_path / "run", lambda report: report.steps >= 1005)
    manifest = read_manifest(find_checkpoint(tmp_path / "run"))
    assert manifest.progress["env_steps"] == 800
    saved = manifest.training["coach"]["strategy"]
    assert set(saved) == {
        "curriculum": {"rate"}, "patient": {"begun"}, "deck": set(),
        "learnability": {"success", "counts"}, "failure": {"success", "counts"},
    }[strategy]  # fmt: skip
    train(config, tmp_path / "run", resume=True)
    assert_same_run(tmp_path / "run", tmp_path / "whole")


def test_every_setting_of_the_recipe_goes_on_where_it_was(tmp_path: Path) -> None:
    """Random actions that are held, strata, lambda-returns, and the best so far."""
    settings = {
        **CONFIG.model_dump(),
        "total_steps": 1600,
        "explore_hold": 6,
        "replay_strata": "outcome",
        "replay_weights": "importance",
        "test_victim_episodes": 1,
        "learner": {**CONFIG.learner.model_dump(), "td_lambda": 0.8, "optimiser": "adam"},
    }
    config = TrainConfig.model_validate(settings)
    train(config, tmp_path / "whole")
    run = tmp_path / "run"
    process = start(run, config)
    wait_until_lines(run, 5, process)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait(timeout=100) == -signal.SIGKILL
    assert read_manifest(find_checkpoint(run)).progress["env_steps"] < 1600
    train(config, run, resume=True)
    assert_same_run(run, tmp_path / "whole")
    (mine,), (theirs,) = (list_checkpoints(folder / BEST) for folder in (run, tmp_path / "whole"))
    assert mine.name == theirs.name
    assert (mine / "agent.safetensors").read_bytes() == (theirs / "agent.safetensors").read_bytes()


SCRIPT = """
import sys
from pathlib import Path
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.run import train
train(TrainConfig.model_validate_json(sys.argv[2]), Path(sys.argv[1]), resume=True)
"""


def start(run: Path, config: TrainConfig = CONFIG) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", SCRIPT, str(run), config.model_dump_json()])


def wait_until_lines(run: Path, count: int, process: subprocess.Popen[bytes]) -> None:
    metrics = run / "metrics.jsonl"
    deadline = time.monotonic() + 100
    while not metrics.exists() or metrics.read_bytes().count(b"\n") < count:
        assert process.poll() is None, "it ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.002)


def test_sigkill_and_resume_changes_no_bit(whole: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    process = start(run)
    wait_until_lines(run, 7, process)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait(timeout=100) == -signal.SIGKILL
    killed_at = read_manifest(find_checkpoint(run)).progress["env_steps"]
    assert 400 <= killed_at < CONFIG.total_steps
    train(CONFIG, run, resume=True)
    assert_same_run(run, whole)


def test_resuming_a_finished_run_changes_nothing(whole: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in whole.rglob("*") if p.is_file()}
    reports: list[ProgressReport] = []
    summary = train(CONFIG, whole, resume=True, progress=reports.append)
    assert summary.steps == 2400
    assert [r.phase for r in reports] == ["finished"]
    after = {p: p.stat().st_mtime_ns for p in whole.rglob("*") if p.is_file()}
    assert set(before) == set(after)
    assert all(before[p] == after[p] for p in before if p.suffix == ".safetensors")


def test_a_damaged_checkpoint_is_named_when_resuming(tmp_path: Path) -> None:
    config = CONFIG.model_copy(update={"total_steps": 400})
    run = tmp_path / "run"
    train(config, run)
    learner = find_checkpoint(run) / "learner.safetensors"
    learner.write_bytes(learner.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match=r"learner\.safetensors has \d+ bytes"):
        train(config, run, resume=True)


def test_metrics_shorter_than_the_checkpoint_knows_are_refused(tmp_path: Path) -> None:
    config = CONFIG.model_copy(update={"total_steps": 400})
    run = tmp_path / "run"
    train(config, run)
    (run / "metrics.jsonl").write_text("")
    with pytest.raises(UserError, match=r"metrics\.jsonl has 0 bytes"):
        train(config, run, resume=True)
