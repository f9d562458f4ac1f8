"""crash-coach bags and record: figures, exit codes, one line per problem."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from bag_maker import Team, messages, played, write

from crash_coach_bringup.cli.main import main
from policy_pkg.bags.writer import Split


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    team = Team()
    folder = tmp_path_factory.mktemp("bags") / "good"
    return write(folder, team, messages(played(team, 4)), Split(episodes=2))


@dataclass(frozen=True)
class Done:
    returncode: int
    stdout: str
    stderr: str


Verb = Callable[..., Done]


@pytest.fixture
def crash_coach(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Verb:
    """The command line, in this process."""

    def run(*arguments: str) -> Done:
        monkeypatch.setattr(sys, "argv", ["crash-coach", *arguments])
        code: object = 0
        try:
            main()
        except SystemExit as end:
            code = end.code
        out, err = capsys.readouterr()
        return Done(int(code or 0), out, err)  # type: ignore[call-overload]

    return run


def test_info(recording: Path, tmp_path: Path, crash_coach: Verb) -> None:
    done = crash_coach("bags", "info", str(recording), "--json", str(tmp_path / "out.json"))
    assert done.returncode == 0, done.stderr
    for text in ("buttons", "robot_1, robot_2", "4 (80 steps)", "mute", "random"):
        assert text in done.stdout
    (bag,) = json.loads((tmp_path / "out.json").read_text())["bags"]
    assert (bag["episodes"], bag["files"], bag["problems"]) == (4, 2, [])


def test_check_tells_damage_apart_from_gaps(
    recording: Path, tmp_path: Path, crash_coach: Verb
) -> None:
    done = crash_coach("bags", "check", str(recording), "--strict")
    assert (done.returncode, done.stdout) == (0, f"{recording}: 4 complete episodes\n")
    team = Team()
    made = messages(played(team, 3))
    stopped = write(tmp_path / "stopped", team, made[:-30])
    done = crash_coach("bags", "check", str(stopped))
    assert done.returncode == 0
    assert done.stdout.startswith("note: ")
    assert "episode 2: left out: it has no end" in done.stdout
    assert crash_coach("bags", "check", str(stopped), "--strict").returncode == 1
    path = stopped / "stopped_0.mcap"
    path.write_bytes(path.read_bytes()[:-500])
    done = crash_coach("bags", "check", str(stopped))
    assert done.returncode == 1
    assert f"problem: {path}: is cut off at byte" in done.stdout


def test_repeated_and_disordered_messages_are_notes(tmp_path: Path, crash_coach: Verb) -> None:
    team = Team()
    sent = messages(played(team, 2))
    folder = write(tmp_path / "bag", team, [*sent, *sent[:3]])
    again = sum(one.topic.startswith("/robot") for one in sent[:3])
    done = crash_coach("bags", "check", str(folder))
    assert done.returncode == 0
    assert f"note: {folder}: {again} messages say nothing new of a robot-step" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("bags", "info", "nowhere"), "nowhere: there is no such file or folder"),
        (("record", "--out", "x"), "whom to record?"),
        (("record", "--out", "x", "--scenario", "bottons"), "bottons"),
    ],
)
def test_errors_are_one_line(arguments: tuple[str, ...], text: str, crash_coach: Verb) -> None:
    done = crash_coach(*arguments)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert text in done.stderr


def test_record_is_the_recorder(tmp_path: Path, ros_env: dict[str, str]) -> None:
    command = [
        sys.executable, "-m", "crash_coach_bringup.cli.main", "record",
        "--out", str(tmp_path / "bag"), "--scenario", "buttons", "--seed", "5",
    ]  # fmt: skip
    child = subprocess.Popen(
        command, env={**os.environ, **ros_env}, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    assert child.stderr is not None
    assert "recording" in child.stderr.readline()
    child.send_signal(signal.SIGINT)
    out, _ = child.communicate(timeout=100)
    assert child.returncode == 0
    assert "0 messages" in out
    text = (tmp_path / "bag" / "metadata.yaml").read_text()
    about = json.loads(text)["rosbag2_bagfile_information"]["custom_data"]
    assert (about["scenario"], about["seed"]) == ('"buttons"', "5")
