"""`crash-coach report`: which runs are seeds of one method, and what a method is called."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from report_cases import write_run

from crash_coach_bringup.cli.report import report
from policy_pkg.train.results import find_runs, method_name, read_runs
from policy_pkg.train.run_dir import RunError


@pytest.mark.parametrize(
    ("folder", "scenario", "coach", "name"),
    [
        ("adaptive-s3", "buttons", "adaptive", "adaptive"),
        ("rho", "buttons", "adaptive", "rho"),
        ("3m-s0", "skirmish/3m", "none", "qmix"),
        ("3m-s0", "skirmish/3m", "adaptive", "qmix, adaptive"),
        ("3m-fix_0.05-s12", "skirmish/3m", "fixed", "fix_0.05"),
        ("fix-8m-s1", "maps/8m.yaml", "fixed", "fix"),
        ("83m-s1", "skirmish/3m", "none", "83m"),
    ],
)
def test_method_names(folder: str, scenario: str, coach: str, name: str) -> None:
    settings = {"learner": {"algorithm": "qmix"}, "coach": {"strategy": coach}}
    assert method_name(Path("runs") / folder, scenario, settings) == name


def test_one_name_for_two_settings_is_told_apart_by_the_folder_above(tmp_path: Path) -> None:
    write_run(tmp_path / "rmsprop" / "qmix-s0")
    write_run(tmp_path / "adam" / "qmix-s0", learner={"optimiser": "adam"})
    found = read_runs(find_runs([tmp_path / "rmsprop", tmp_path / "adam"]))
    assert [run.method for run in found] == ["rmsprop/qmix", "adam/qmix"]


def test_runs_that_cannot_be_seeds_of_one_method_are_refused(tmp_path: Path) -> None:
    write_run(tmp_path / "qmix-s0")
    write_run(tmp_path / "qmix-s1", seed=1, learner={"lr": 0.001})
    with pytest.raises(RunError, match=r"learner\.lr is 0\.0005 in one and 0\.001 in the other"):
        read_runs(find_runs([tmp_path]))
    shutil.rmtree(tmp_path / "qmix-s1")
    shutil.copytree(tmp_path / "qmix-s0", tmp_path / "qmix-s1")
    with pytest.raises(RunError, match="both 'qmix' on buttons with seed 0"):
        read_runs(find_runs([tmp_path]))


def test_a_method_may_have_other_settings_on_another_map(tmp_path: Path) -> None:
    write_run(tmp_path / "buttons" / "qmix-s0")
    write_run(tmp_path / "buttons_8" / "qmix-s0", "buttons_8", batch_episodes=16)
    found = read_runs(find_runs([tmp_path / "buttons", tmp_path / "buttons_8"]))
    assert [run.method for run in found] == ["qmix", "qmix"]
    report([run.path for run in found], out=tmp_path / "report", episodes=2, crashed=[0])
    text = (tmp_path / "report" / "table.md").read_text()
    assert "the maps: batch_episodes is 32 on buttons, 16 on buttons_8." in text
    assert text.count("Settings differ") == 1
