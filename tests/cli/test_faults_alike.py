"""`crash-coach faults run` where nothing is left to chance: one episode, not many."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from in_process import typed

from crash_coach_bringup.cli.playing import ALIKE
from crash_coach_pkg.coach.fault_scenario import ScenarioPlanner, load_fault_scenario
from crash_coach_pkg.team import TeamSpec
from sim_pkg.env import make_env

HOLD = ("--policy", "scripted:hold", "--scenario", "buttons", "--episodes", "3")


def file_of(folder: Path, fault: str, expect: str) -> str:
    path = folder / "mine.yaml"
    path.write_text(f"description: d\nfaults: [{{{fault}}}]\nexpect: [{expect}]\n")
    return str(path)


def test_identical_pairs_are_one_episode_without_an_interval(tmp_path: Path) -> None:
    expect = "{success_rate: {at_least: 0}}, {effects: {}}"
    file, out = file_of(tmp_path, "victims: [robot_1]", expect), tmp_path / "report"
    done = typed("faults", "run", file, *HOLD, "--out", str(out))
    assert done.returncode == 0, done.stderr
    assert " 0.0 % (1 episode)" in done.stdout
    assert "100.0 % (1 episode)" in done.stdout
    assert ALIKE in done.stdout
    result = json.loads((out / "result.json").read_text())
    assert [verdict["ci95"] for verdict in result["verdicts"]] == [None, None]
    assert result["faulted"]["alike"]
    page = (out / "report.md").read_text()
    assert ".." not in page.partition("## With the faults")[0]


@pytest.mark.parametrize(
    ("fault", "draws"),
    [
        ("victims: [robot_1]", False),
        ("crashed_exactly: 2", False),
        ("crashed_exactly: 0", False),
        ("victims: [robot_2], return_above: 1.0", False),
        ("crashed_exactly: 1", True),
        ("min_alive: 1", True),
        ("victims: [robot_1], crash_mode: random", True),
        ("victims: [robot_1], hazard_rate_hz: 0.1", True),
    ],
)
def test_what_a_file_leaves_to_chance(tmp_path: Path, fault: str, draws: bool) -> None:
    scenario = load_fault_scenario(Path(file_of(tmp_path, fault, "{effects: {}}")))
    planner = ScenarioPlanner(scenario, TeamSpec.of(make_env("buttons", 1).spec), 0)
    assert planner.draws is draws
    plans = {repr(planner.plan(episode).faults) for episode in range(20)}
    assert draws or len(plans) == 1
