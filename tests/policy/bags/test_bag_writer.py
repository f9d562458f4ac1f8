"""The writing side: what a kill leaves, drops, splits, and folders in use."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from bag_maker import STORE, Made, Team, messages, write

from crash_coach_common.contract import UserError
from policy_pkg.bags import writer as writer_module
from policy_pkg.bags.about import About, about_from_record
from policy_pkg.bags.bag import Bag, Scan, bag_entries
from policy_pkg.bags.problems import Problem
from policy_pkg.bags.recorder import Recorder
from policy_pkg.bags.records import Entry
from policy_pkg.bags.writer import BagWriter, Split

ENDLESS = """
import sys, time
from pathlib import Path
from bag_maker import STORE, Team
from policy_pkg.bags.recorder import Recorder
from policy_pkg.bags.writer import BagWriter
team = Team()
index = {c.topic: i for i, c in enumerate(team.connections)}
writer = BagWriter(Path(sys.argv[1]), team.connections, STORE, team.about, time.monotonic)
recorder = Recorder(writer, team.connections, STORE, 10_000)
print("recording", flush=True)
while True:
    for sent in team.play().sent:
        recorder.put(index[sent.topic], sent.data)
        time.sleep(0.001)
"""

SLACK_S = 1.0  # a busy machine lets the writer wait


def test_a_kill_loses_at_most_the_last_second(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    path = os.pathsep.join(sys.path)
    child = subprocess.Popen(
        [sys.executable, "-c", ENDLESS, str(folder)],
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert child.stdout is not None
        assert child.stdout.readline() == "recording\n"
        file, end_s = folder / "bag_0.mcap", time.monotonic() + 60
        while not file.exists() or file.stat().st_size < 10_000:
            assert time.monotonic() < end_s, "nothing is written"
            time.sleep(0.05)
        time.sleep(1.5)
    finally:
        killed_ns = time.time_ns()
        child.send_signal(signal.SIGKILL)
        child.wait(10)
    assert (folder / "metadata.yaml").exists()
    bag = Bag("bag", (folder / "bag_0.mcap",))
    problems: list[Problem] = []
    times = [e.log_time_ns for e in bag_entries(bag, problems.append) if isinstance(e, Entry)]
    assert killed_ns - max(times) < (1.0 + SLACK_S) * 1e9
    assert len(problems) == 1
    assert "cut off" in str(problems[0])
    assert Scan(bag).about == Team().about


def test_what_finds_the_queue_full_is_counted(tmp_path: Path, team: Team, made: list[Made]) -> None:
    folder = tmp_path / "bag"
    writer = BagWriter(folder, team.connections, STORE, team.about, time.monotonic)
    recorder = Recorder(writer, team.connections, STORE, queue_messages=10)
    index = {c.topic: i for i, c in enumerate(team.connections)}
    sent = messages(made)
    for one in sent:
        recorder.put(index[one.topic], one.data)
    recorder.close()
    dropped = sum(recorder.drops.values())
    assert dropped > 0
    assert recorder.messages + dropped == len(sent)
    items = list(bag_entries(Bag("bag", (folder / "bag_0.mcap",)), lambda p: None))
    assert len([i for i in items if isinstance(i, Entry)]) == recorder.messages
    abouts = [i for i in items if isinstance(i, About)]
    assert dict(abouts[-1].drops) == recorder.drops
    metadata = json.loads((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert json.loads(metadata["custom_data"]["drops"]) == recorder.drops


def test_metadata_is_there_from_the_start(tmp_path: Path, team: Team) -> None:
    BagWriter(tmp_path / "bag", team.connections, STORE, team.about, time.monotonic)
    text = (tmp_path / "bag" / "metadata.yaml").read_text()
    found = json.loads(text)["rosbag2_bagfile_information"]
    assert found["relative_file_paths"] == ["bag_0.mcap"]
    assert found["storage_identifier"] == "mcap"


def test_a_split_is_written_down_at_once(tmp_path: Path, team: Team, made: list[Made]) -> None:
    folder = write(tmp_path / "bag", team, messages(made), Split(episodes=4), ends=False)
    found = json.loads((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert found["relative_file_paths"] == ["bag_0.mcap", "bag_1.mcap"]
    assert found["message_count"] == len(messages(made[:4]))


def test_a_folder_in_use_is_refused(tmp_path: Path, team: Team) -> None:
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "notes.txt").touch()
    with pytest.raises(UserError, match="is not empty"):
        BagWriter(tmp_path / "bag", team.connections, STORE, team.about, time.monotonic)
    with pytest.raises(UserError, match="compression 'rar'"):
        write(tmp_path / "b", team, [], compression="rar")


def test_a_recording_that_cannot_be_begun_leaves_nothing(
    tmp_path: Path, team: Team, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(UserError, match="bag: No space left on device"):
        BagWriter(tmp_path / "bag", team.connections, STORE, team.about, time.monotonic)
    assert list((tmp_path / "bag").iterdir()) == []


def test_a_recording_that_began_here_at_the_same_moment_is_left_alone(
    tmp_path: Path, team: Team, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write(tmp_path / "bag", team, [])
    there = {path.name: path.read_bytes() for path in folder.iterdir()}
    monkeypatch.setattr(writer_module, "_make", lambda folder: None)  # it looked before
    with pytest.raises(UserError, match="is not empty"):
        BagWriter(folder, team.connections, STORE, team.about, time.monotonic)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == there


def test_the_recordings_words_are_protected(team: Team) -> None:
    record = team.about.to_record()
    assert about_from_record(record) == team.about
    with pytest.raises(UserError, match="checksum"):
        about_from_record({**record, "scenario": '"bottons"'})
