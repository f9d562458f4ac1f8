"""`crash-coach render`, and evaluate of scripted teams: the command as it is installed."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from bag_maker import Team, messages, played, write
from in_process import refused, typed

from crash_coach_bringup.cli.main import main
from crash_coach_bringup.cli.verbs import calibrate
from crash_coach_bringup.ros.probe import find_executable
from policy_pkg.play.conditions import exactly, named
from policy_pkg.play.evaluate import Scripted, evaluate, evaluation_seed, record
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env
from sim_pkg.render.frames import Frames

RANDOM = ("scripted:random", "--scenario", "buttons")


def crash_coach(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [str(find_executable("crash_coach_bringup", "crash-coach")), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=250)


def render(*arguments: str) -> str:
    done = crash_coach("render", *arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_it_draws_the_episode_that_evaluate_plays(tmp_path: Path) -> None:
    out, report = tmp_path / "film.gif", tmp_path / "film.json"
    text = render(
        *RANDOM, "--seed", "4", "--episode", "2", "--victims", "robot_2", "--speed", "20",
        "--out", str(out), "--json", str(report),
    )  # fmt: skip
    assert "crashed: robot_2" in text
    assert out.read_bytes().startswith(b"GIF8")
    told = json.loads(report.read_text())
    key = evaluation_seed(4)
    played = evaluate(Scripted("random"), "buttons", named(["robot_2"]), 3, key).episodes[2]
    assert told["trajectory_hash"] == played.trajectory_hash
    assert (told["steps"], told["crashed"]) == (played.steps, [1])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["film.gif", "film.json"]


def test_it_draws_a_trained_team_on_its_own_scenario(tmp_path: Path) -> None:
    run = tmp_path / "step_000000000"
    write_untrained(run, make_env("buttons", 1).spec, seed=1)
    render(str(run), "--out", str(tmp_path / "still.png"))
    assert (tmp_path / "still.png").read_bytes().startswith(b"\x89PNG")


Here = Callable[..., tuple[int, str]]


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Here:
    """The command line in this process: exit code, and all that it printed."""

    def run(*arguments: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["crash-coach", *arguments])
        code = 0
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
        return code, "".join(capsys.readouterr())

    return run


def test_it_draws_a_recorded_episode(tmp_path: Path, here: Here) -> None:
    team = Team("skirmish/3m")
    bag = str(write(tmp_path / "bag", team, messages(played(team, 2))))
    out, report = tmp_path / "still.png", tmp_path / "still.json"
    code, text = here("render", bag, "--episode", "1", "--out", str(out), "--json", str(report))
    assert code == 0, text
    assert "episode 1: no success" in text
    assert out.read_bytes().startswith(b"\x89PNG")
    told = json.loads(report.read_text())
    assert (told["recording"], told["seed"], told["episode"]) == (bag, 3, 1)
    assert told["trajectory_hash"] == team.session.trajectory_hash
    assert told["modes"] == ["mute", "random"]
    some = ("--out", str(tmp_path / "x.png"))
    code, text = here("render", bag, "--episode", "7", *some)
    assert (code, "no complete episode 7; complete: 0..1" in text) == (1, True), text
    code, text = here("render", bag, "--victims", "robot_1", *some)
    assert (code, "--victims has no meaning with a recording" in text) == (1, True), text
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bag", "still.json", "still.png"]


def test_a_recording_of_an_unknown_scenario_is_named(tmp_path: Path, here: Here) -> None:
    team = Team()
    sent = team.play().sent
    lab = replace(team.about, scenario="lab.yaml")
    elsewhere = str(write(tmp_path / "a", team, sent, about=lab))
    some = ("--out", str(tmp_path / "x.png"))
    code, text = here("render", elsewhere, *some)
    assert code == 1
    assert "recorded with a scenario that is not here" in text
    assert "lab.yaml" in text
    assert here("render", elsewhere, "--scenario", "buttons", *some)[0] == 0
    untold = str(write(tmp_path / "b", team, sent, about=replace(team.about, scenario="")))
    code, text = here("render", untold, *some)
    assert (code, "does not name its scenario" in text) == (1, True), text


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (("--out", "x.avi"), "x.avi: a file ending in .mp4, .gif, .png"),
        (("--out", "/dev/null/where/x.png"), "/dev/null is not a folder"),
        (("--out", "x.png", "--speed", "0"), "--speed 0.0"),
        (("--out", "x.png", "--episode", str(10**20)), "--episode"),
        (("--out", "x.png", "--json", "."), "--json .: is a directory"),
        (("--out", "x.png", "--crashed", "9"), "--crashed 9: the team has 2 robots"),
        (("--out", "x.png", "--crashed", "1", "--victims", "robot_1"), "under one of them"),
    ],
)
def test_bad_input_names_the_thing(
    arguments: tuple[str, ...], names: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert names in refused("render", *RANDOM, *arguments)
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_scripted_team_is_named() -> None:
    assert "--scenario is needed" in refused("evaluate", "scripted:random")
    text = refused("evaluate", "scripted:nearst", "--scenario", "skirmish/3m")
    assert "unknown scripted policy 'nearst' (did you mean 'nearest'?)" in text
    assert "does not play scenario 'buttons'" in refused(
        "evaluate", "scripted:nearest", "--scenario", "buttons"
    )


def test_calibrate_counts_wins_and_losses(tmp_path: Path) -> None:
    out = tmp_path / "calibration.json"
    done = typed(
        *("calibrate", "skirmish/3m", "buttons", "--policy", "random", "hold"),
        *("--crashed", "0", "1", "--episodes", "8", "--json", str(out)),
    )
    assert done.returncode == 0, done.stderr
    rows = json.loads(out.read_text())["rows"]
    assert [(r["scenario"], r["policy"], r["condition"]) for r in rows] == [
        (scenario, policy, condition)
        for scenario in ("skirmish/3m", "buttons")
        for policy in ("random", "hold")
        for condition in ("0 crashed", "1 crashed")
    ]
    held = rows[2]
    assert (held["success_rate"], held["robots_lost_mean"], held["opponents_lost_mean"]) == (
        0,
        3,
        0,
    )
    key = evaluation_seed(0)
    played = evaluate(Scripted("random"), "skirmish/3m", exactly(1), 8, key).summary()
    for name in ("success_rate", "success_ci95", "steps_mean", "return_mean"):
        assert rows[1][name] == pytest.approx(played[name])
    assert rows[4]["robots_lost_mean"] == 0


def test_calibrate_counts_alike_however_many_it_keeps(monkeypatch: pytest.MonkeyPatch) -> None:
    args = ("focus", "skirmish/3m", exactly(1, "stay"), 10, 3)
    whole = calibrate.tally(*args)
    kept = []

    def some(*args: Any) -> list[Frames]:
        kept.append(record(*args))
        return kept[-1]

    monkeypatch.setattr(calibrate, "AT_ONCE", 4)
    monkeypatch.setattr(calibrate, "record", some)
    parts = calibrate.tally(*args)
    assert [[frames.episode for frames in frames_] for frames_ in kept] == [
        [0, 1, 2, 3], [4, 5, 6, 7], [8, 9],
    ]  # fmt: skip
    assert parts == whole
    assert parts.episodes == 10
    assert parts.opponents_lost > 0


def test_calibrate_refuses_what_it_cannot_play() -> None:
    assert "no scenario" in refused("calibrate")
    assert "does not play scenario 'buttons'" in refused(
        "calibrate", "buttons", "--policy", "kite", "--episodes", "1"
    )
    done = typed("calibrate", "buttons", "coverag", "--policy", "hold", "--episodes", "1")
    assert "unknown scenario 'coverag' (did you mean 'coverage'?)" in done.stderr
    assert done.stdout == "", "refused before anything is played"
