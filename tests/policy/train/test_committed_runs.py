"""Committed runs of when strategies had no settings of their own still play and say the same."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from policy_pkg.checkpoint import load_policy
from policy_pkg.play.conditions import crash_free, named
from policy_pkg.play.evaluate import evaluate
from policy_pkg.report.finished_runs import find_runs, last_metrics, read_runs
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.run_dir import read_run

RESULTS = Path(__file__).resolve().parents[3] / "results"
RUN = RESULTS / "gridworld/adaptive-s4"


def test_its_settings_are_the_strategys_now() -> None:
    (run,) = read_runs([RUN])
    assert run.method == "adaptive"
    coach = run.settings["coach"]
    assert coach["adaptive"] == {"beta": 0.75, "rho": 0.01, "alpha_max": 1.0}
    assert not {"beta", "rho", "alpha_max", "curriculum", "curriculum_fraction"} & set(coach)
    assert last_metrics(RUN)["env_steps"] == 2_000_000


def test_it_acts() -> None:
    team, last = load_policy(RUN), last_metrics(RUN)
    free = evaluate(team, "buttons", crash_free(), 1, 0)
    assert free.success_rate == last["success_crash_free"]
    alone = evaluate(team, "buttons", named(("robot_1",)), 1, 0)
    assert alone.episodes[0].crashed == (0,)


def test_every_committed_run_can_be_read() -> None:
    folders = sorted({path.parent.parent for path in RESULTS.rglob("run.json")})
    assert len(folders) > 5
    for run in find_runs(folders):
        config = read_run(run)["config"]
        if "total_steps" in config:
            TrainConfig.model_validate(config)


def old(folder: Path, **coach: object) -> Path:
    """A copy of RUN's description in which the coach had other settings."""
    folder.mkdir()
    content = json.loads(shutil.copy(RUN / "run.json", folder / "run.json").read_text())
    content["config"]["coach"].update(coach)
    (folder / "run.json").write_text(json.dumps(content))
    return folder


def test_a_curriculum_of_then(tmp_path: Path) -> None:
    by_steps = old(tmp_path / "a", strategy="curriculum", alpha_max=0.2, curriculum_fraction=0.4)
    config = TrainConfig.model_validate(read_run(by_steps)["config"])
    assert config.coach.settings.model_dump() == {"alpha_max": 0.2, "fraction": 0.4, "episodes": 0}
    by_episodes = old(tmp_path / "b", strategy="curriculum", curriculum_delta=0.002)
    config = TrainConfig.model_validate(read_run(by_episodes)["config"])
    assert config.coach.settings.model_dump() == {"alpha_max": 0.1, "fraction": 0.5, "episodes": 50}
