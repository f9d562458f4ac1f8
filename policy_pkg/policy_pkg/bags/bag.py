"""Folders to recordings: which files belong together, and what they say about themselves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from crash_coach_common.contract import UserError
from crash_coach_common.natural import natural
from policy_pkg.bags.about import About, about_from_record
from policy_pkg.bags.problems import BagError, Problem, Report
from policy_pkg.bags.records import Channel, ChannelTable, Entry, channels_of, entries
from policy_pkg.bags.topics import kind_of


@dataclass(frozen=True)
class Bag:
    """One recording: the MCAP files of one folder, or a single file."""

    name: str
    files: tuple[Path, ...]


def find_bags(paths: Sequence[Path]) -> list[Bag]:
    """The recordings in ``paths``: files, folders of a recording, folders of such folders.

    Raises:
        BagError: a path without any, naming what is there instead.
    """
    bags: dict[Path, Bag] = {}
    for path in paths:
        found = _below(path)
        if not found:
            raise BagError(f"{path}: {_instead(path)}")
        for bag in found:
            bags.setdefault(bag.files[0].resolve(), bag)
    return list(bags.values())


def holds_bags(path: Path) -> bool:
    """Whether ``find_bags`` would find a recording there."""
    return bool(_below(path))


def is_recording(path: Path) -> bool:
    """Whether it is meant as one: ``find_bags`` tells what is wrong with unreadable ones."""
    if path.is_file():
        return path.suffix in (".mcap", ".db3")
    return path.is_dir() and ((path / "metadata.yaml").exists() or holds_bags(path))


def _below(path: Path) -> list[Bag]:
    if path.is_file() and path.suffix == ".mcap":
        return [Bag(str(path), (path,))]
    if not path.is_dir():
        return []
    files = sorted(path.glob("*.mcap"), key=lambda p: natural(p.name))
    if files:
        return [Bag(str(path), tuple(files))]
    folders = sorted((p for p in path.iterdir() if p.is_dir()), key=lambda p: natural(p.name))
    return [bag for folder in folders for bag in _below(folder)]


def _instead(path: Path) -> str:
    if not path.exists():
        return "there is no such file or folder"
    if any(path.glob("*.db3")) or path.suffix == ".db3":
        return "an SQLite recording; convert it: rosbags-convert --dst-storage mcap"
    if any(path.glob("*.mcap.*")):
        return "its files are compressed as a whole; decompress them (zstd -d *.mcap.zstd)"
    return "no MCAP recording in it"


class Scan:
    """What is known of a bag before its messages are read.

    about: the recorder's own words; None for a recording of `ros2 bag record`.
    kinds: of the messages that the bag holds; of a file without an end, what its first chunk lists.
    certain: those of them of which there are messages for certain.
    robots: in the team's order.
    """

    def __init__(self, bag: Bag) -> None:
        self.about: About | None = None
        certain: set[Channel] = set()
        possible: set[Channel] = set()
        for path in bag.files:
            found, listed = channels_of(path)
            begun = self._begin(path)
            certain |= found
            possible |= found if listed else begun
        matches = [match for c in possible if (match := kind_of(c.topic)) is not None]
        self.kinds = {kind for kind, _ in matches}
        self.certain = {match[0] for c in certain if (match := kind_of(c.topic)) is not None}
        self.robots = tuple(sorted({robot for _, robot in matches if robot}, key=natural))
        if self.about is not None:
            self.robots = self.about.robots

    def _begin(self, path: Path) -> set[Channel]:
        """Reads a file up to its first message; returns the channels so far."""
        table = ChannelTable()
        for item in entries(path, lambda problem: None, table):  # told when the file is read
            if isinstance(item, Entry):
                break
            if self.about is None:
                with suppress(UserError):
                    self.about = about_from_record(item)
        return set(table.channels.values())


def bag_entries(bag: Bag, report: Report) -> Iterator[Entry | About]:
    """Everything in a bag, file after file."""
    for path in bag.files:
        for item in entries(path, report):
            if isinstance(item, Entry):
                yield item
                continue
            try:
                yield about_from_record(item)
            except UserError as error:
                report(Problem(str(path), str(error)))
