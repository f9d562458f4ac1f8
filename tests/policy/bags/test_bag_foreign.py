"""Recordings that hold more than ours: other encodings, messages compressed one by one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard
from bag_maker import Team, messages, played, write
from mcap.reader import make_reader
from mcap.writer import Writer
from test_bag_damage import read

Rewrite = Callable[[bytes], bytes]
# Encoding of the schema, its bytes, encoding of the messages.
FOREIGN = {
    "protobuf": ("protobuf", bytes(range(256)), "protobuf"),
    "json": ("jsonschema", b'{"type": "object"}', "json"),
    "unknown": ("of-tomorrow", b"\xff\xfe\x00", "of-tomorrow"),
    "none": ("", b"", "raw"),
}


def rewritten(source: Path, target: Path, change: Rewrite, foreign: str = "") -> Path:
    """A copy of a recording's file, every message through ``change``, a foreign channel beside."""
    (file,) = source.glob("*.mcap")
    target.mkdir()
    with file.open("rb") as old, (target / file.name).open("wb") as new:
        writer = Writer(new)
        writer.start(profile="ros2")
        other = _foreign_channel(writer, foreign) if foreign else None
        known: dict[int, int] = {}
        for schema, channel, message in make_reader(old).iter_messages():
            assert schema is not None
            if channel.id not in known:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                known[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number
                )
            if other is not None:
                writer.add_message(other, message.log_time, b"\x80\x81\x82", message.log_time)
            writer.add_message(
                known[channel.id], message.log_time, change(message.data), message.publish_time
            )
        writer.finish()
    return target


def _foreign_channel(writer: Writer, foreign: str) -> int:
    encoding, data, of_messages = FOREIGN[foreign]
    schema = writer.register_schema("foreign.Camera", encoding, data) if encoding else 0
    return writer.register_channel("/camera", of_messages, schema)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    team = Team()
    return write(tmp_path_factory.mktemp("bag") / "own", team, messages(played(team, 2)))


def plain(data: bytes) -> bytes:
    return data


@pytest.mark.parametrize("foreign", FOREIGN)
def test_a_foreign_channel_is_skipped_by_name(
    tmp_path: Path, recording: Path, foreign: str
) -> None:
    own, _ = read(recording)
    found, problems = read(rewritten(recording, tmp_path / "bag", plain, foreign))
    assert not problems
    assert len(found) == len(own) == 2


@pytest.mark.parametrize("sized", [True, False])
def test_messages_compressed_one_by_one_are_read(
    tmp_path: Path, recording: Path, sized: bool
) -> None:
    compressor = zstandard.ZstdCompressor(write_content_size=sized)
    found, problems = read(rewritten(recording, tmp_path / "bag", compressor.compress))
    assert not problems
    assert len(found) == 2


def test_a_message_that_cannot_be_decompressed_is_named(tmp_path: Path, recording: Path) -> None:
    packed = zstandard.ZstdCompressor().compress
    cut = rewritten(recording, tmp_path / "bag", lambda data: packed(data)[:-6])
    found, problems = read(cut)
    assert not found
    assert any("compressed by itself cannot be read" in str(problem) for problem in problems)


def test_a_foreign_encoding_on_a_topic_of_ours_is_named(tmp_path: Path, recording: Path) -> None:
    target = tmp_path / "bag.mcap"
    with target.open("wb") as out:
        writer = Writer(out)
        writer.start()
        schema = writer.register_schema("Observation", "jsonschema", b"{}")
        for robot in ("robot_1", "robot_2"):
            channel = writer.register_channel(f"/{robot}/observation", "json", schema)
            writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    found, problems = read(recording, target)
    assert len(found) == 2
    assert any("has type Observation, not crash_coach" in str(problem) for problem in problems)
