"""`crash-coach faults`: what it plays, judges, writes and refuses."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import pytest
from typer.testing import CliRunner, Result

from crash_coach_bringup.cli.faults.play import play
from crash_coach_bringup.cli.faults.report import FILES
from crash_coach_bringup.cli.faults.verb import app
from crash_coach_bringup.cli.options import Layout, Via
from crash_coach_bringup.ros.probe import find_executable
from crash_coach_common.contract import UserError
from crash_coach_pkg.coach.fault_scenario import (
    ScenarioPlanner,
    fault_scenario_names,
    find_fault_scenario,
    load_fault_scenario,
)
from crash_coach_pkg.team import TeamSpec
from policy_pkg.play.conditions import crash_free
from policy_pkg.play.evaluate import evaluate, evaluation_seed
from policy_pkg.play.target import Target, load_target
from policy_pkg.report.verdict import FaultRun, judge_run
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

COVERAGE = ("--policy", "scripted:coverage_adaptive", "--scenario", "coverage")
QUICK = ("--policy", "scripted:hold", "--scenario", "buttons", "--episodes", "3")
MUTE = "description: d\nfaults: [{crashed_exactly: 1, start_step: 2, duration_steps: 3}]\n"


def faults(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


def refused(*arguments: str) -> str:
    """The error with which a verb refuses."""
    done = faults(*arguments)
    assert isinstance(done.exception, UserError), done.output
    assert "\n" not in str(done.exception)
    return str(done.exception)


def file_of(folder: Path, expect: str, head: str = MUTE) -> str:
    path = folder / "mine.yaml"
    path.write_text(f"{head}expect:\n  - {expect}\n")
    return str(path)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("policy") / "step_000000000"
    write_untrained(path, make_env("buttons", 1).spec, seed=1)
    return path


def played(name: str, target: Target, episodes: int) -> FaultRun:
    scenario = load_fault_scenario(find_fault_scenario(name))
    return play(scenario, target, episodes, 0, Via.core, Layout.nodes)


@pytest.mark.parametrize("name", fault_scenario_names())
def test_every_shipped_file_plays_and_takes_effect(name: str, checkpoint: Path) -> None:
    scenario = load_fault_scenario(find_fault_scenario(name))
    team = str(checkpoint) if scenario.config.scenario == "buttons" else "scripted:coverage_fixed"
    target = load_target(team, scenario.config.scenario)
    run = played(name, target, 4)
    assert len(run.verdicts) == len(scenario.expect)
    (effects,) = (verdict for verdict in run.verdicts if verdict.name == "effects")
    assert effects.passed, effects
    assert all(entry.robot_steps > 0 for entry in run.entries)
    again = played(name, target, 4)
    assert again.faulted == run.faulted, "the same file and seed: the same events and hashes"


def test_the_pair_without_faults_is_the_plain_evaluation() -> None:
    target = load_target("scripted:coverage_fixed", "coverage")
    run = played("hazard", target, 3)
    assert run.crash_free == evaluate(target.team, "coverage", crash_free(), 3, evaluation_seed(0))
    assert [pair.episode for pair in run.trials.pairs] == [0, 1, 2]
    hashes = [e.trajectory_hash for e in run.faulted.episodes]
    assert hashes != [e.trajectory_hash for e in run.crash_free.episodes]


def test_effects_are_those_of_the_plan(tmp_path: Path) -> None:
    scenario = load_fault_scenario(Path(file_of(tmp_path, "effects: {}")))
    target = load_target("scripted:hold", "buttons")
    run = play(scenario, target, 20, 3, Via.core, Layout.nodes)
    planner = ScenarioPlanner(
        scenario, TeamSpec.of(make_env("buttons", 1).spec), evaluation_seed(3)
    )
    expected = set()
    for episode in range(20):
        (fault,) = planner.plan(episode).faults
        expected |= {(episode, step, target.robots[fault.robot]) for step in (2, 3, 4)}
    effects = [row for row in run.faulted.effects if row.kind == "EFFECT"]
    assert {(row.episode, row.step, row.robot) for row in effects} == expected
    assert len(effects) == len(expected)
    (entry,) = run.entries
    assert (entry.due, entry.took_effect, entry.robot_steps) == (20, 20, 60)


def test_a_fault_after_the_end_of_its_episode_was_not_due(tmp_path: Path) -> None:
    """Crash-free, demo episodes of coverage end long before step 79, the last possible one."""
    text = "description: d\nfaults: [{victims: [robot_1], start_step: 79}]\n"
    scenario = load_fault_scenario(Path(file_of(tmp_path, "effects: {}", text)))
    target = load_target("scripted:coverage_adaptive", "coverage")
    run = play(scenario, target, 2, 0, Via.core, Layout.nodes)
    assert [pair.due for pair in run.trials.pairs] == [(), ()]
    assert run.verdicts[0].finding.status == "failed"
    assert "never due: entry 0" in run.verdicts[0].finding.note
    assert [pair.faulted for pair in run.trials.pairs] == [
        pair.crash_free for pair in run.trials.pairs
    ]


def test_a_fault_that_only_meets_a_dead_robot_takes_no_effect(tmp_path: Path) -> None:
    """Standing still, robots of 3m are dead long before the end of its 60 steps."""
    text = "description: d\nfaults: [{victims: [robot_1], start_step: START}]\n"
    found = {}
    for start in (0, 20):
        file = file_of(tmp_path, "effects: {}", text.replace("START", str(start)))
        target = load_target("scripted:nearest", "skirmish/3m")
        run = play(load_fault_scenario(Path(file)), target, 12, 0, Via.core, Layout.nodes)
        due = [fault for pair in run.trials.pairs for fault in pair.due]
        found[start] = run.verdicts[0].finding, due
    early, due = found[0]
    assert (early.status, early.note, len(due)) == ("passed", "", 12)
    late, due = found[20]
    dead = sum(fault.met_dead for fault in due)
    assert dead > 0
    assert (late.status, late.counts) == ("failed", (len(due) - dead, len(due)))
    assert late.note == f"{dead} only met a robot that was out of action already"


def test_other_episodes_are_not_paired() -> None:
    target = load_target("scripted:hold", "buttons")
    scenario = load_fault_scenario(find_fault_scenario("one_mute"))
    planner = ScenarioPlanner(scenario, TeamSpec.of(make_env("buttons", 1).spec), 0)
    two, three = (evaluate(target.team, "buttons", crash_free(), n, 0) for n in (2, 3))
    with pytest.raises(ValueError, match="not paired"):
        judge_run(scenario, planner, two, three)


def test_a_run_that_passes_writes_everything(tmp_path: Path) -> None:
    out = tmp_path / "report"
    done = faults("run", "lossy_link", *COVERAGE, "--episodes", "3", "--out", str(out))
    assert done.exit_code == 0, done.output
    assert {path.name for path in out.iterdir()} == FILES
    result = json.loads((out / "result.json").read_text())
    assert result["passed"] is True
    rows = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
    assert {row["mode"] for row in rows} == {"drop"}
    assert sum(row["kind"] == "EFFECT" for row in rows) == result["entries"][0]["robot_steps"]
    page = (out / "report.md").read_text()
    for verdict in result["verdicts"]:
        assert verdict["status"] == "passed"
        assert verdict["wanted"] in page
    assert result["faulted"]["trajectory_hash"] in page
    for figure in ("success.png", "returns.png", "timeline.png"):
        assert (out / figure).read_bytes().startswith(b"\x89PNG")
        assert f"({figure})" in page
    assert [path.name for path in tmp_path.iterdir()] == ["report"]


def test_the_report_names_the_episodes_that_were_lost(tmp_path: Path) -> None:
    head = "description: d\nfaults: [{victims: [robot_2]}]\n"
    file, out = file_of(tmp_path, "effects: {}", head), tmp_path / "report"
    team = ("--policy", "scripted:coverage_fixed", "--scenario", "coverage", "--episodes", "2")
    assert faults("run", file, *team, "--out", str(out)).exit_code == 0
    page = (out / "report.md").read_text()
    assert "## Episodes lost to the faults: 2 of 2\n" in page
    assert "| 1 | robot_2 | " in page


def test_a_second_run_replaces_the_report_with_the_same(tmp_path: Path) -> None:
    file = file_of(tmp_path, "effects: {}")
    out = tmp_path / "report"
    first = []
    for _ in range(2):
        assert faults("run", file, *QUICK, "--out", str(out)).exit_code == 0
        first.append([(out / n).read_bytes() for n in ("result.json", "events.jsonl", "report.md")])
    assert first[0] == first[1]


def test_junit_tells_what_failed_and_why(tmp_path: Path) -> None:
    head = MUTE.replace("description: d", 'description: "a < b & \\x01 c"')
    expect = (
        "effects: {}\n  - success_rate: {at_least: 0.5}\n  - return_retained: {at_least: 0.5}\n"
        "  - return_drop: {at_most: 0}"
    )
    out = tmp_path / "report"
    done = faults("run", file_of(tmp_path, expect, head), *QUICK, "--out", str(out))
    assert done.exit_code == 1
    assert done.exception is None or isinstance(done.exception, SystemExit)
    root = ElementTree.parse(out / "junit.xml").getroot()
    (suite,) = root
    for element in (root, suite):
        counts = [element.get(name) for name in ("tests", "failures", "errors")]
        assert counts == ["4", "1", "1"]
        assert float(element.attrib["time"]) >= 0
    assert (suite.get("name"), suite.get("skipped")) == ("mine", "0")
    assert "T" in suite.attrib["timestamp"]
    properties = {p.attrib["name"]: p.attrib["value"] for p in suite.iter("property")}
    assert properties["description"] == "a < b & \ufffd c"
    assert (properties["seed"], properties["episodes"]) == ("0", "3")
    cases = suite.findall("testcase")
    assert len({case.attrib["name"] for case in cases}) == 4
    assert {case.attrib["classname"] for case in cases} == {"faults.mine"}
    inside = [[child.tag for child in case] for case in cases]
    assert inside == [[], ["failure"], ["error"], []]
    (failure,) = cases[1]
    assert "wanted: success rate at least 50 %; measured: 0.0 % (0.0..56.1) of 3" in str(
        failure.text
    )
    assert failure.get("message") == failure.text
    assert failure.get("type") == "success_rate"
    (error,) = cases[2]
    assert "return_drop" in str(error.text)


def test_no_expectation_is_no_pass(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(MUTE)
    assert "mine.yaml expects nothing" in refused("run", str(path), *QUICK)


def test_a_report_takes_the_place_of_nothing_else(tmp_path: Path) -> None:
    file = file_of(tmp_path, "effects: {}")
    mine = tmp_path / "notes"
    mine.mkdir()
    (mine / "thesis.tex").write_text("x")
    assert "holds 'thesis.tex'" in refused("run", file, *QUICK, "--out", str(mine))
    assert "is not a folder" in refused("run", file, *QUICK, "--out", file)
    assert "is not a folder" in refused("run", file, *QUICK, "--out", f"{file}/b")
    # The folder that takes its place at the end has a longer name, and cannot be made.
    before = sorted(tmp_path.rglob("*"))
    long = tmp_path / ("n" * 250)
    assert "cannot be written" in refused("run", file, *QUICK, "--out", str(long))
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (("run", "one_mut", *QUICK), "did you mean 'one_mute'"),
        (("run", "adversary", *QUICK), "adversary.yaml:4: faults.0: crash_mode: .* values least"),
        (("run", "hazard", "--policy", "scripted:hold", "--scenario", "buttons"), "min_alive 3"),
        (("check", "one_mute", "--scenario", "button"), "did you mean 'buttons'"),
    ],
)
def test_what_cannot_be_played_is_refused(arguments: tuple[str, ...], names: str) -> None:
    done = faults(*arguments)
    assert isinstance(done.exception, UserError), done.output
    with pytest.raises(UserError, match=names):
        raise done.exception


def test_check_names_the_line_of_a_start_that_is_never_reached(tmp_path: Path) -> None:
    head = "description: d\nfaults:\n  - crash_mode: mute\n    start_step: 20\n"
    file = file_of(tmp_path, "effects: {}", head)
    done = faults("check", file)
    assert done.exit_code == 0
    assert "not held against a scenario" in done.output
    text = refused("check", file, "--scenario", "buttons")
    assert "mine.yaml:4: faults.0: start_step 20 is never reached" in text
    assert "velocities" in refused(
        "check", file_of(tmp_path, "effects: {}", MUTE.replace("{", "{crash_mode: bias, ")),
        "--scenario", "buttons",
    )  # fmt: skip


def test_list_names_every_shipped_file() -> None:
    output = faults("list").output
    for name in fault_scenario_names():
        assert name in output


def crash_coach(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [str(find_executable("crash_coach_bringup", "crash-coach")), "faults", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=250)


def test_the_installed_command_exits_with_the_verdict(tmp_path: Path) -> None:
    fails = crash_coach("run", file_of(tmp_path, "return_drop: {at_most: -1}"), *QUICK)
    assert (fails.returncode, fails.stderr) == (1, "")
    assert "failed" in fails.stdout
    wrong = crash_coach("run", *QUICK, file_of(tmp_path, "return_drop: {at_mst: -1}"))
    assert (wrong.returncode, wrong.stdout) == (1, "")
    assert wrong.stderr.startswith("crash-coach: error: ")
    assert "mine.yaml:4: unknown key" in wrong.stderr
    assert wrong.stderr.count("\n") == 1
