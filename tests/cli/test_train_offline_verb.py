"""`crash-coach train-offline`: from recordings to a policy, and one line for what goes wrong."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_maker import Made, Team, messages, played, write

from crash_coach_bringup.cli.main import main
from crash_coach_bringup.cli.report.success import in_recordings
from crash_coach_bringup.cli.report.verb import report
from crash_coach_bringup.ros.probe import find_executable
from policy_pkg.bags.about import same_scenario
from policy_pkg.bags.dataset import load_episodes
from policy_pkg.checkpoint import load_policy
from policy_pkg.report.finished_runs import find_runs, read_runs
from policy_pkg.train.offline.data import load_data

QUICK = [
    "--set", "gradient_steps=6", "batch_episodes=4", "test_interval_steps=3", "test_episodes=2",
    "loggers.tensorboard=false", "learner.hidden=8",
]  # fmt: skip


Typed = Callable[..., tuple[int, str]]


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Typed:
    """Types a command line; returns the exit code and what went to stderr."""

    def run(*arguments: str | Path) -> tuple[int, str]:
        command = ["crash-coach", "train-offline", *map(str, arguments)]
        monkeypatch.setattr("sys.argv", command)
        with pytest.raises(SystemExit) as ended:
            main()
        return int(ended.value.code or 0), capsys.readouterr().err

    return run


Refused = Callable[..., str]


@pytest.fixture
def refused(typed: Typed) -> Refused:
    """Types a command line; returns the one line with which it is refused."""

    def run(*arguments: str | Path) -> str:
        code, line = typed(*arguments)
        assert (code, line.count("\n")) == (1, 1)
        return line

    return run


def trained(*arguments: str | Path) -> str:
    """What the installed command prints; it must succeed."""
    command = [find_executable("crash_coach_bringup", "crash-coach"), "train-offline", *arguments]
    done = subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, timeout=250
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory, team: Team, made: list[Made]) -> list[Path]:
    """Two recordings of three episodes each, in two folders."""
    parent = tmp_path_factory.mktemp("bags")
    halves = (made[:3], made[3:])
    return [write(parent / str(i), team, messages(half)) for i, half in enumerate(halves)]


def test_recordings_become_a_policy(typed: Typed, tmp_path: Path, bags: list[Path]) -> None:
    run = tmp_path / "run"
    rest = ("--out", run, "--seed", "4", *QUICK)
    assert "6 gradient steps on 6 episodes" in trained("offline/qmix", *bags, *rest)
    described = json.loads((run / "run.json").read_text())
    assert (described["seed"], described["data"]["episodes"]) == (4, 6)
    assert described["data"]["sources"] == [str(bag) for bag in bags]
    assert load_policy(run).robots == ("robot_1", "robot_2")
    before = (run / "metrics.jsonl").read_bytes()
    assert before.count(b"\n") == 3

    assert typed("offline/qmix", *reversed(bags), "--resume", *rest) == (0, "")
    assert (run / "metrics.jsonl").read_bytes() == before


def test_several_seeds_are_runs_of_their_own(
    typed: Typed, tmp_path: Path, bags: list[Path]
) -> None:
    one, several = tmp_path / "one", tmp_path / "several"
    numbers = "episode_numbers=[0, 4]"
    rest = (*QUICK, numbers, "--seed")
    assert typed("offline/qmix", *bags, "--out", one, *rest, "2") == (0, "")
    for resumed in (False, True):
        again = ("--resume",) if resumed else ()
        command = ("offline/qmix", *bags, "--out", several, *again, *rest, "1", "2")
        assert typed(*command) == (0, "")
        assert sorted(run.name for run in several.iterdir()) == ["qmix-s1", "qmix-s2"]
        metrics = [(run / "metrics.jsonl").read_bytes() for run in (several / "qmix-s2", one)]
        assert metrics[0] == metrics[1]
    assert json.loads((one / "run.json").read_text())["data"]["episodes"] == 5


def test_the_report_knows_how_well_the_recorded_team_did(
    typed: Typed, tmp_path: Path, bags: list[Path], made: list[Made]
) -> None:
    runs = tmp_path / "runs"
    command = ("offline/behaviour_cloning", *bags, "--out", runs, *QUICK, "--seed", "1", "2")
    assert typed(*command) == (0, "")
    report([runs], out=tmp_path / "report", episodes=2, crashed=[0])
    assert (tmp_path / "report" / "success.png").stat().st_size > 500
    (row,) = json.loads((tmp_path / "report" / "results.json").read_text())["rows"]
    assert (row["method"], row["seeds"]) == ("behaviour_cloning", [1, 2])
    rate = sum(one.success for one in made) / len(made)
    assert in_recordings(read_runs(find_runs([runs]))) == {("buttons", row["method"]): rate}


def test_recordings_of_another_scenario_are_refused(
    refused: Refused, tmp_path: Path, team: Team, made: list[Made]
) -> None:
    here = write(tmp_path / "here", team, messages(made))
    there = replace(team.about, scenario="coverage")
    other = write(tmp_path / "other", team, messages(made), about=there)
    line = refused("offline/qmix", here, other, "--out", tmp_path / "x", *QUICK)
    assert f"{other}: recorded on scenario 'coverage', {here} on 'buttons'" in line
    line = refused("offline/qmix", other, "--out", tmp_path / "x", *QUICK)
    assert "was recorded on scenario 'coverage', not on 'buttons' as the configuration" in line
    assert [one.scenario for one in load_episodes([other], strict=True)] == ["coverage"] * len(made)


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("buttons", "buttons", True),
        ("buttons", "", True),
        ("skirmish/3m", "skirmish/2s3z", False),
        ("skirmish/3m", "other/3m", False),
        ("mine/four.yaml", "/there/four.yaml", True),
        ("mine/four.yaml", "/there/five.yaml", False),
        ("buttons", "copy/buttons.yaml", True),
    ],
)
def test_scenarios_are_told_apart(one: str, other: str, same: bool) -> None:
    assert same_scenario(one, other) is same_scenario(other, one) is same


def test_wrong_arguments_are_one_line(refused: Refused, tmp_path: Path, bags: list[Path]) -> None:
    out = ("--out", tmp_path / "run")
    assert "nowhere" in refused("offline/qmix", tmp_path / "nowhere", *out)
    line = refused("buttons/qmix", bags[0], *out)
    assert "no training config 'buttons/qmix'" in line
    shutil.copytree(bags[0], tmp_path / "copy")
    line = refused("offline/qmix", bags[0], tmp_path / "copy", *out, *QUICK)
    assert "episodes repeat another one (same seed, number and content)" in line
    assert "name it once, or give --repeated" in line
    line = refused("offline/qmix", bags[0], *out, "--seed", "1", "1")
    assert "--seed 1 1: a seed comes twice" in line
    line = refused("offline/qmix", bags[0], *out, "--set", "episode_numbers=[7, 9]")
    assert "no complete episode numbered 7 to 9: there is nothing to learn from" in line
    line = refused("offline/qmix", bags[0], *out, "--set", "batch_episodes=50")
    assert line == ("crash-coach: error: batch_episodes 50 is more than the 3 recorded episodes\n")
    assert not (tmp_path / "run").exists()


def test_recordings_of_another_team_are_refused(
    refused: Refused, tmp_path: Path, team: Team, made: list[Made]
) -> None:
    untold = write(tmp_path / "bag", team, messages(made), about=replace(team.about, scenario=""))
    line = refused("offline/qmix", untold, "--out", tmp_path / "x", *QUICK, "scenario=transport_4")
    assert "has 2 robots (robot_1, robot_2), scenario 'transport_4' has 4" in line


def test_an_empty_recording_is_refused(refused: Refused, tmp_path: Path, team: Team) -> None:
    bag = write(tmp_path / "bag", team, [])
    line = refused("offline/qmix", bag, "--out", tmp_path / "x")
    assert "there is nothing to learn from" in line


def test_faults_of_every_kind_are_counted(tmp_path: Path) -> None:
    """Faulted robots' intents differ from what they executed, and that is no contradiction."""
    team = Team(relay=True, p_fault=0.1)
    made = played(team, 4)
    folder = write(tmp_path / "bag", team, messages(made))
    data = load_data(load_episodes([folder], strict=True), team.spec, 1)
    expected = [int(one.episode.faults.any(0).sum()) for one in made]
    assert data.crashed.tolist() == expected
    batch = data.episodes.gather(np.arange(4))
    for i, slot in enumerate(batch.slots):
        faults = batch.faults[batch.episode == i]
        np.testing.assert_array_equal(faults, made[slot].episode.faults)
