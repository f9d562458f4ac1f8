"""`crash-coach report`: which runs are seeds of one method, and what a method is called."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from report_cases import write_run

from crash_coach_bringup.cli.figure_style import style
from crash_coach_bringup.cli.report.curves import learning_curves
from crash_coach_bringup.cli.report.figures import resilience
from crash_coach_bringup.cli.report.verb import report
from policy_pkg.play.conditions import exactly
from policy_pkg.report.finished_runs import find_runs, method_name, read_runs
from policy_pkg.report.kept_evaluations import Evaluations
from policy_pkg.report.rows import rows
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


def test_methods_keep_the_order_they_are_given_in_and_their_colours(tmp_path: Path) -> None:
    """Also where the first map lacks a method that is listed before one of its own."""
    given = [
        ("buttons", "vdn"),
        ("buttons_8", "central"),
        ("buttons", "qmix"),
        ("buttons_8", "vdn"),
    ]
    runs = []
    for scenario, name in given:
        run = write_run(tmp_path / scenario / f"{name}-s0", scenario)
        lines = [{"env_steps": k, "success_crash_free": 0.5} for k in (0, 200)]
        (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        runs.append(run)
    found = read_runs(runs)
    conditions = [exactly(k) for k in (0, 1)]
    kept = Evaluations(tmp_path / "evaluations", 2, 0)
    results = [kept.result(run, conditions, lambda condition: None) for run in found]
    places = [(row.scenario, row.method) for row in rows(results, []) if row.crashed == 0]
    assert places == [
        ("buttons", "vdn"), ("buttons", "qmix"), ("buttons_8", "vdn"), ("buttons_8", "central"),
    ]  # fmt: skip
    methods = ["vdn", "central", "qmix"]
    measured = resilience(rows(results, []), methods)
    learned = learning_curves(found, methods)
    assert learned is not None
    for figure in (measured, learned):
        (legend,) = figure.legends
        drawn = [(handle.get_label(), handle.get_color()) for handle in legend.get_lines()]
        assert drawn == [(name, style(place)[0]) for place, name in enumerate(methods)]
        lines = [line for line in figure.axes[0].get_lines() if len(line.get_xdata())]
        colours = {line.get_color() for line in lines}
        assert colours == {style(0)[0], style(2)[0]}
