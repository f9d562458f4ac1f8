"""What was played comes back from a recording bit for bit, however it was written."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_maker import STORE, Made, Sent, Team, messages, played, write
from rosbags.interfaces import Qos
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from crash_coach_common.contract import UserError
from policy_pkg.bags.dataset import RecordedEpisode, load_episodes
from policy_pkg.bags.writer import Split

EVENT = "crash_coach_interfaces/msg/FaultEvent"
ARRAYS = ("obs", "state", "available", "actions", "reward", "faults")


def same(made: Made, got: RecordedEpisode) -> None:
    assert (got.number, got.seed, got.success) == (made.number, made.seed, made.success)
    assert got.episode.terminated is made.episode.terminated
    for name in ARRAYS:
        one, other = getattr(made.episode, name), getattr(got.episode, name)
        assert one.dtype == other.dtype, name
        assert one.tobytes() == other.tobytes(), name
    assert np.array_equal(made.intents, got.intents)
    assert {tuple(key) for key in np.argwhere(made.episode.faults).tolist()} == set(got.modes)


def compare(made: list[Made], got: list[RecordedEpisode]) -> None:
    got = sorted(got, key=lambda one: one.number)
    assert [one.number for one in got] == [one.number for one in made]
    for mine, theirs in zip(made, got, strict=True):
        same(mine, theirs)


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_every_compression(tmp_path: Path, team: Team, made: list[Made], compression: str) -> None:
    folder = write(tmp_path / "bag", team, messages(made), compression=compression)
    compare(made, list(load_episodes([folder], strict=True)))


@pytest.mark.parametrize("split", [Split(episodes=2), Split(bytes=6000)])
def test_split_recordings(tmp_path: Path, team: Team, made: list[Made], split: Split) -> None:
    folder = write(tmp_path / "bag", team, messages(made), split, compression="none")
    assert len(list(folder.glob("*.mcap"))) >= 3
    compare(made, list(load_episodes([folder], strict=True)))


@pytest.mark.parametrize("seed", range(3))
def test_messages_in_any_order_and_twice(
    tmp_path: Path, team: Team, made: list[Made], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    sent = messages(made)
    sent = [*sent, *(sent[i] for i in rng.integers(len(sent), size=len(sent) // 3))]
    shuffled = [sent[i] for i in rng.permutation(len(sent))]
    folder = write(tmp_path / "bag", team, shuffled, Split(bytes=20_000), compression="none")
    compare(made, list(load_episodes([folder], strict=True)))


def test_files_under_other_names(tmp_path: Path, team: Team, made: list[Made]) -> None:
    folder = write(tmp_path / "bag", team, messages(made), Split(episodes=1))
    for name, path in zip("fbeadc", sorted(folder.glob("*.mcap")), strict=False):
        path.rename(folder / f"{name}.mcap")
    (folder / "metadata.yaml").unlink()
    compare(made, list(load_episodes([folder], strict=True)))


def test_observations_that_the_gate_changed(tmp_path: Path) -> None:
    team = Team(seed=5, relay=True)
    made = played(team, 3)
    assert any((one.episode.faults == 20).any() for one in made)
    folder = write(tmp_path / "bag", team, messages(made))
    compare(made, list(load_episodes([folder], strict=True)))


def test_an_episode_cut_short_keeps_its_last_situation(tmp_path: Path) -> None:
    team = Team(seed=6)
    made = [team.play(), team.play(cut_at=4), team.play()]
    assert made[1].episode.obs[4].any()
    assert not made[1].episode.terminated
    folder = write(tmp_path / "bag", team, messages(made))
    compare(made, list(load_episodes([folder], strict=True)))


def test_an_unfinished_file_gives_what_reached_it(tmp_path: Path) -> None:
    team = Team()
    made = played(team, 6)
    folder = write(tmp_path / "bag", team, messages(made), ends=False)
    problems: list[str] = []
    got = list(load_episodes([folder], report=lambda p: problems.append(str(p))))
    assert len(got) >= 4
    compare(made[: len(got)], got)
    assert "cut off" in problems[0]
    with pytest.raises(UserError, match="cut off"):
        list(load_episodes([folder], strict=True))


def test_in_real_time_a_command_serves_for_several_steps(tmp_path: Path) -> None:
    team = Team(seed=4, p_fault=1.0)
    (made,) = played(team, 1)
    twice = (made.episode.faults[1:, 0] == 2) & (made.episode.faults[:-1, 0] == 2)
    step = int(np.flatnonzero(twice)[0]) + 1
    sent = [
        one
        for one in made.sent
        if not (one.topic == "/robot_1/command" and step_of(one, "Action") == step)
        and not (
            one.topic == "/coach/events"
            and STORE.deserialize_cdr(one.data, EVENT).robot == "robot_1"
            and step_of(one, "FaultEvent") == step
        )
    ]
    assert len(sent) == len(made.sent) - 2
    about = replace(team.about, mode="realtime")
    (got,) = load_episodes([write(tmp_path / "real", team, sent, about=about)], strict=True)
    assert np.array_equal(got.episode.faults, made.episode.faults)
    with pytest.raises(UserError, match=f"robot_1's step {step}"):
        list(load_episodes([write(tmp_path / "lock", team, sent)], strict=True))


def step_of(sent: Sent, msgtype: str) -> int:
    message = STORE.deserialize_cdr(sent.data, f"crash_coach_interfaces/msg/{msgtype}")
    return int(message.step)  # type: ignore[attr-defined]


def test_several_bags_are_one_data_set(tmp_path: Path) -> None:
    numbers = []
    for seed in (1, 2):
        team = Team(seed=seed)
        made = played(team, 2)
        write(tmp_path / "all" / f"bag_{seed}", team, messages(made))
        numbers += [(seed, one.number) for one in made]
    got = list(load_episodes([tmp_path / "all"], strict=True))
    assert [(one.seed, one.number) for one in got] == numbers
    twice = load_episodes([tmp_path / "all", tmp_path / "all" / "bag_1"], strict=True)
    assert len(list(twice)) == len(got)


def test_little_memory_gives_the_same_or_says_so(
    tmp_path: Path, team: Team, made: list[Made]
) -> None:
    folder = write(tmp_path / "bag", team, messages(made))
    compare(made, list(load_episodes([folder], strict=True, memory_bytes=100_000)))
    problems: list[str] = []
    got = list(load_episodes([folder], report=lambda p: problems.append(str(p)), memory_bytes=1000))
    assert not got
    assert len(problems) >= len(made)


def foreign(folder: Path, sent: list[Sent]) -> None:
    """As `ros2 bag record -a`: another writer, no word of ours, topics that we do not know."""
    types = {
        "observation": "Observation", "command": "Action", "command_raw": "Action",
        "episode": "EpisodeState", "events": "FaultEvent",
    }  # fmt: skip
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        known = {}
        text = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=STORE)
        qos: list[Qos] = []
        for count, one in enumerate(sent):
            name = f"crash_coach_interfaces/msg/{types[one.topic.rpartition('/')[2]]}"
            if one.topic not in known:
                known[one.topic] = writer.add_connection(
                    one.topic, name, typestore=STORE, offered_qos_profiles=qos
                )
            writer.write(known[one.topic], 1000 + count, one.data)
            if count % 50 == 0:
                said = STORE.types["std_msgs/msg/String"]("hello")
                writer.write(text, 1000 + count, STORE.serialize_cdr(said, "std_msgs/msg/String"))


def test_a_recording_of_another_writer(tmp_path: Path, made: list[Made]) -> None:
    foreign(tmp_path / "bag", messages(made))
    compare(made, list(load_episodes([tmp_path / "bag"], strict=True)))


def test_rosbags_opens_ours(tmp_path: Path, team: Team, made: list[Made]) -> None:
    folder = write(tmp_path / "bag", team, messages(made), Split(episodes=2))
    sent = messages(made)
    with Reader(folder) as reader:
        assert reader.message_count == len(sent)
        qos = {c.topic: c.ext.offered_qos_profiles[0].depth for c in reader.connections}
        assert qos["/coach/events"] == 100
        got = [(c.topic, bytes(data)) for c, _, data in reader.messages()]
    assert got == [(one.topic, one.data) for one in sent]
    metadata = json.loads((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert metadata["custom_data"]["scenario"] == '"buttons"'
    assert len(metadata["files"]) == len(metadata["relative_file_paths"])


def test_an_independent_reader_decodes_everything(
    tmp_path: Path, team: Team, made: list[Made]
) -> None:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    folder = write(tmp_path / "bag", team, messages(made))
    sent = messages(made)
    with (folder / "bag_0.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = [(c.topic, m) for _, c, _, m in reader.iter_decoded_messages()]
    assert [topic for topic, _ in decoded] == [one.topic for one in sent]
    ends = [m for topic, m in decoded if topic == "/sim/episode" and m.terminated]
    assert [m.episode for m in ends] == [one.number for one in made]
    first = next(m for topic, m in decoded if topic == "/robot_1/observation")
    assert np.array_equal(np.array(first.features, np.float32), made[0].episode.obs[0, 0])
