"""A run needs nothing but its own folder: its scenario travels with it; Ctrl-C loses nothing."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import yaml
from in_process import refused, typed

from policy_pkg.train.config import TrainConfig
from policy_pkg.train.run import EndedEarly, train
from sim_pkg.env import make_env
from sim_pkg.scenario_files import find_scenario
from sim_pkg.scenario_source import read_scenario
from sim_pkg.scenarios.skirmish.config import UNITS_FILE

SETTINGS: dict[str, Any] = {
    "total_steps": 600,
    "n_envs": 4,
    "updates_per_episode": 0.5,
    "batch_episodes": 4,
    "replay_episodes": 20,
    "test_interval_steps": 200,
    "test_episodes": 4,
    "checkpoint_interval_steps": 200,
    "loggers": {"tensorboard": False},
    "learner": {"hidden": 16, "mixing_hidden": 8, "hypernet_hidden": 8},
}


def config(scenario: str, **changes: Any) -> TrainConfig:
    return TrainConfig.model_validate({**SETTINGS, "scenario": scenario, **changes})


def evaluated(run: Path, out: Path) -> tuple[str, Any]:
    done = typed("evaluate", str(run), "--crashed", "0", "1", "--episodes", "4", "--json", str(out))
    assert done.returncode == 0, done.stderr
    return done.stdout, json.loads(out.read_text())["conditions"]


def test_a_run_that_was_moved_evaluates_to_the_same_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    there.mkdir()
    monkeypatch.chdir(here)
    shutil.copy(find_scenario("buttons"), "hall.yaml")
    train(config("hall.yaml"), Path("run"))
    said, before = evaluated(Path("run"), here / "a.json")
    assert "has changed" not in said
    shutil.move("run", there / "moved")
    monkeypatch.chdir(there)
    assert evaluated(Path("moved"), there / "b.json")[1] == before
    # The file changes: the run goes on meaning what it meant, and says so.
    monkeypatch.chdir(here)
    hall = Path("hall.yaml")
    hall.write_text(hall.read_text().replace("episode_limit: 20", "episode_limit: 3"))
    said, after = evaluated(there / "moved", here / "c.json")
    assert "scenario hall.yaml has changed since" in " ".join(said.split())
    assert after == before
    today = typed("evaluate", str(there / "moved"), "--scenario", "hall.yaml", "--episodes", "2")
    assert " 3.0 " in today.stdout
    copy = there / "moved" / "scenario" / "hall.yaml"
    copy.write_text(copy.read_text() + "# touched\n")
    assert "sha256 differs" in refused("evaluate", str(there / "moved"), "--episodes", "2")


def test_a_maps_unit_types_travel_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = read_scenario("skirmish/3m").write(tmp_path / "copy")
    assert read_scenario(copy).sha256 == read_scenario("skirmish/3m").sha256
    units = tmp_path / "copy" / UNITS_FILE.name
    content = yaml.safe_load(units.read_text())
    content["unit_types"]["marine"]["health"] = 7.0
    units.write_text(yaml.safe_dump(content))
    healths = [
        make_env(scenario, 1).config.units[0].health  # type: ignore[attr-defined]
        for scenario in ("skirmish/3m", copy)
    ]
    assert healths[1] == 7.0 != healths[0]


def test_a_run_that_was_stopped_anywhere_is_as_if_it_never_had(tmp_path: Path) -> None:
    train(config("buttons"), tmp_path / "whole")
    seen: list[int] = []

    def stopped() -> bool:
        seen.append(1)
        return len(seen) == 67

    with pytest.raises(EndedEarly):
        train(config("buttons"), tmp_path / "run", stopped=stopped)
    assert (tmp_path / "run/checkpoints/step_000000264").is_dir()
    train(config("buttons"), tmp_path / "run", resume=True)
    agent = "checkpoints/step_000000600/agent.safetensors"
    assert (tmp_path / "run" / agent).read_bytes() == (tmp_path / "whole" / agent).read_bytes()
    metrics = [(tmp_path / run / "metrics.jsonl").read_bytes() for run in ("run", "whole")]
    assert metrics[0] == metrics[1]


@pytest.mark.timeout(360)
def test_ctrl_c_saves_and_says_how_to_go_on(tmp_path: Path) -> None:
    run = tmp_path / "run"
    settings = [f"{key}={json.dumps(value)}" for key, value in SETTINGS.items() if key != "learner"]
    command = [sys.executable, "-c", "from crash_coach_bringup.cli.main import main; main()",
               "train", "buttons/qmix", "--out", str(run), "--set", *settings,
               "total_steps=50000000"]  # fmt: skip
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env={**os.environ}
    )
    try:
        end_s = time.monotonic() + 200
        metrics = run / "metrics.jsonl"
        while not metrics.exists() or metrics.read_text().count("\n") < 2:
            assert process.poll() is None
            assert time.monotonic() < end_s
            time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=250)
    finally:
        process.kill()
    assert process.returncode == 130, said
    assert "the same command with --resume goes on from there" in said
    assert list((run / "checkpoints").iterdir())
