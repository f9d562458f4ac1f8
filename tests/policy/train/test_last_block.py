"""However a run comes to its last step: all three trainers leave a block and a checkpoint."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from live_player import SPEC, live, small
from offline_recordings import Recording, buttons_recordings
from offline_runs import small as small_offline
from offline_runs import train_offline

from policy_pkg.checkpoint import find_checkpoint, load_policy, read_manifest
from policy_pkg.train.progress import ProgressReport
from policy_pkg.train.run import train

UNITS = {"train": 200, "live": 200, "offline": 10}


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    return buttons_recordings(20)


def run_to_the_end(kind: str, run: Path, recordings: list[Recording], **settings: int) -> None:
    if kind == "offline":
        steps = settings.pop("total_steps")
        train_offline(small_offline(gradient_steps=steps, **settings), recordings, run, resume=True)
    elif kind == "train":
        train(small(n_envs=3, **settings), run, resume=True)
    else:
        live(small(**settings), run, resume=True)


@pytest.mark.parametrize("kind", UNITS)
@pytest.mark.parametrize(
    ("total", "interval", "checkpoints"),
    [(3, 1, 1), (2.5, 1, 1), (0.5, 1, 1), (0.9, 5, 50), (2.5, 1, 50), (1, 1, 50)],
    ids=["multiple", "between", "short", "one-block", "one-checkpoint", "first-interval"],
)
def test_the_end_has_its_block_and_its_checkpoint(
    tmp_path: Path,
    recordings: list[Recording],
    kind: str,
    total: float,
    interval: int,
    checkpoints: int,
) -> None:
    unit, run = UNITS[kind], tmp_path / "run"
    settings = {
        "total_steps": int(total * unit),
        "test_interval_steps": interval * unit,
        "checkpoint_interval_steps": checkpoints * unit,
    }
    run_to_the_end(kind, run, recordings, **settings)
    key = "gradient_steps" if kind == "offline" else "env_steps"
    steps = [json.loads(line)[key] for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert steps[0] == 0
    assert steps[-1] >= settings["total_steps"]
    assert steps == sorted(set(steps))  # none twice
    assert read_manifest(find_checkpoint(run)).progress[key] == steps[-1]
    assert load_policy(run).robots == SPEC.robots
    before = (run / "metrics.jsonl").read_bytes()
    run_to_the_end(kind, run, recordings, **settings)  # nothing is left to do
    assert (run / "metrics.jsonl").read_bytes() == before


class Killed(Exception):
    pass


def test_a_run_that_is_stopped_on_its_last_step_plays_the_block_when_resumed(
    tmp_path: Path,
) -> None:
    config = small(n_envs=3, total_steps=500, checkpoint_interval_steps=200)

    def stop(report: ProgressReport) -> None:
        if report.phase == "evaluation" and report.steps >= 500:
            raise Killed

    with pytest.raises(Killed):
        train(config, tmp_path / "run", progress=stop)
    summary = train(config, tmp_path / "run", resume=True)
    train(config, tmp_path / "whole")
    files = [
        (folder / "metrics.jsonl").read_bytes()
        for folder in (tmp_path / "run", summary.out_dir, tmp_path / "whole")
    ]
    assert len(set(files)) == 1


def test_a_checkpoint_of_before_knows_no_last_block_between_the_intervals(tmp_path: Path) -> None:
    """Its next block lay behind the end; now the end has one."""
    config = small(n_envs=3, total_steps=500, checkpoint_interval_steps=200)

    def stop(report: ProgressReport) -> None:
        if report.phase == "evaluation" and report.steps >= 500:
            raise Killed

    run = tmp_path / "run"
    with pytest.raises(Killed):
        train(config, run, progress=stop)
    path = find_checkpoint(run) / "checkpoint.json"
    manifest = json.loads(path.read_text())
    assert manifest["progress"]["next_block_steps"] == 500
    manifest["progress"]["next_block_steps"] = 600
    path.write_text(json.dumps(manifest))
    assert train(config, run, resume=True).last_block["env_steps"] >= 500
