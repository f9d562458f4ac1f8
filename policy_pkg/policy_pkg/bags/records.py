"""The messages of an MCAP file, also of one that is damaged or was never finished.

Everything a length or count in the file says is checked before memory is taken for it.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.reader import SeekingReader
from mcap.records import Channel as McapChannel
from mcap.records import Chunk, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, StreamReader

from policy_pkg.bags.about import RECORD
from policy_pkg.bags.problems import Problem, Report

MAX_RECORD_BYTES = 1 << 28
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_ZSTD = b"\x28\xb5\x2f\xfd"  # how a frame of it begins
_SCHEMA, _CHANNEL, _MESSAGE_CODE = 0x03, 0x04, 0x05
_BROKEN = (
    McapError, CRCValidationError, struct.error, UnicodeDecodeError, ValueError, OverflowError,
    EOFError, MemoryError, zstandard.ZstdError, RuntimeError,
)  # fmt: skip


@dataclass(frozen=True)
class Channel:
    """A topic as one file describes it. Equal ones are one object within a file."""

    topic: str
    msgtype: str
    encoding: str
    definition_encoding: str
    definition: bytes  # not text in every encoding: it is decoded only where it is needed


@dataclass(frozen=True, slots=True)
class Entry:
    """One serialized message."""

    channel: Channel
    log_time_ns: int
    data: bytes


class ChannelTable:
    """A file's schemas and channels by id."""

    def __init__(self) -> None:
        self._schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}

    def schema(self, record: Schema) -> None:
        self._schemas[record.id] = record

    def channel(self, record: McapChannel) -> None:
        schema = self._schemas.get(record.schema_id)
        channel = Channel(
            topic=record.topic,
            msgtype=schema.name if schema else "",
            encoding=record.message_encoding,
            definition_encoding=schema.encoding if schema else "",
            definition=schema.data if schema else b"",
        )
        known = self.channels.get(record.id)
        if known is None:
            self.channels[record.id] = channel
        elif known != channel:
            raise ValueError(f"channel {record.id} is described twice, differently")

    def entry(self, channel_id: int, log_time_ns: int, data: bytes) -> Entry:
        channel = self.channels.get(channel_id)
        if channel is None:
            raise ValueError(f"a message on channel {channel_id}, which is not described")
        return Entry(channel, log_time_ns, data)


def uncompressed(data: bytes) -> bytes:
    """A message as it was sent; `ros2 bag record --compression-mode message` compresses each one.

    Raises:
        ValueError: it cannot be decompressed, or says to be larger than MAX_RECORD_BYTES.
    """
    if data[: len(_ZSTD)] != _ZSTD:  # CDR begins with a zero
        return data
    try:
        size = zstandard.frame_content_size(data)
        if size > MAX_RECORD_BYTES:
            raise ValueError(f"it says to hold {size} bytes, more than {MAX_RECORD_BYTES}")
        limit = size if size >= 0 else MAX_RECORD_BYTES
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=limit)
    except zstandard.ZstdError as error:
        raise ValueError(f"a message compressed by itself cannot be read: {error}") from error


def channels_of(path: Path) -> tuple[set[Channel], bool]:
    """(channels with messages, whether the file lists them at its end): an unfinished one does not.

    Never fails: what is damaged shows when the file is read.
    """
    try:
        with path.open("rb") as file:
            summary = SeekingReader(file, record_size_limit=MAX_RECORD_BYTES).get_summary()
            if summary is None or summary.statistics is None:
                return set(), False
            table = ChannelTable()
            for schema in summary.schemas.values():
                table.schema(schema)
            for channel in summary.channels.values():
                table.channel(channel)
            counts = summary.statistics.channel_message_counts
            return {c for i, c in table.channels.items() if counts.get(i, 0) > 0}, True
    except (OSError, *_BROKEN):
        return set(), False


def entries(
    path: Path, report: Report, table: ChannelTable | None = None
) -> Iterator[Entry | dict[str, str]]:
    """Every message in the order of the file, and every metadata record called crash_coach.

    A damaged chunk is reported and left out; where the file's structure is lost, the rest is.
    table: filled with the file's channels as they come.
    """
    table = table or ChannelTable()
    try:
        file = path.open("rb")
    except OSError as error:
        report(Problem(str(path), f"cannot be read: {error.strerror}"))
        return
    with file:
        size = path.stat().st_size
        limit = min(size, MAX_RECORD_BYTES)
        reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=limit)
        records = reader.records
        while True:
            try:
                record = next(records)
            except StopIteration:
                return
            except _BROKEN as error:
                report(_lost(path, file.tell(), error))
                return
            try:
                yield from _contents(record, table)
            except _BROKEN as error:
                if file.tell() >= size:  # cut off within this record, which is told next
                    continue
                where = f"a {type(record).__name__.lower()} record before byte {file.tell()}"
                report(Problem(str(path), f"{where} is damaged and left out: {_why(error)}"))


def _contents(record: Any, table: ChannelTable) -> Iterator[Entry | dict[str, str]]:
    if isinstance(record, Chunk):
        # Whole, before anything of it is used.
        yield from list(_split(_decompressed(record), table))
    elif isinstance(record, Message):
        yield table.entry(record.channel_id, record.log_time, record.data)
    elif isinstance(record, Schema):
        table.schema(record)
    elif isinstance(record, McapChannel):
        table.channel(record)
    elif isinstance(record, Metadata) and record.name == RECORD:
        yield record.metadata


def _decompressed(chunk: Chunk) -> bytes:
    size = chunk.uncompressed_size
    if size > MAX_RECORD_BYTES:
        raise ValueError(f"it says to hold {size} bytes, more than {MAX_RECORD_BYTES}")
    if chunk.compression == "zstd":
        stated = zstandard.frame_content_size(chunk.data)
        if stated not in (size, -1):
            raise ValueError(f"its zstd frame holds {stated} bytes, not {size}")
        data = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise ValueError(f"unknown compression {chunk.compression!r}")
    if len(data) != size:
        raise ValueError(f"it holds {len(data)} bytes, not {size}")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("its CRC does not fit")
    return data


def _split(data: bytes, table: ChannelTable) -> Iterator[Entry]:
    at, end = 0, len(data)
    while at < end:
        code, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        if length > end - at:
            raise ValueError(f"a record of {length} bytes where {end - at} are left")
        if code == _MESSAGE_CODE:
            if length < _MESSAGE.size:
                raise ValueError(f"a message record of {length} bytes")
            channel_id, _, log_time, _ = _MESSAGE.unpack_from(data, at)
            yield table.entry(channel_id, log_time, data[at + _MESSAGE.size : at + length])
        elif code == _SCHEMA:
            table.schema(Schema.read(_stream(data, at, length)))
        elif code == _CHANNEL:
            table.channel(McapChannel.read(_stream(data, at, length)))
        at += length


def _stream(data: bytes, at: int, length: int) -> ReadDataStream:
    return ReadDataStream(BytesIO(data[at : at + length]))


def _lost(path: Path, at: int, error: BaseException) -> Problem:
    size = path.stat().st_size
    if isinstance(error, EndOfFile) or at >= size:
        text = f"is cut off at byte {size}: the recorder was killed, or the file was truncated"
        return Problem(str(path), text)
    return Problem(str(path), f"is damaged before byte {at}; the rest is left out: {_why(error)}")


def _why(error: BaseException) -> str:
    if isinstance(error, CRCValidationError):
        return "the CRC of the data section does not fit"
    text = " ".join(str(error).split())
    return text or type(error).__name__
