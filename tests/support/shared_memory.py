"""What killed nodes left of Fast DDS in shared memory: who takes their port later waits for it."""

from __future__ import annotations

import fcntl
import os
import re
import signal
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from node_process import Child

FOLDER = Path("/dev/shm")
_NAME = re.compile(r"fastrtps_(port\d+|[0-9a-f]{16})")
_MAPPED = re.compile(rf"{FOLDER}/({_NAME.pattern})$", re.MULTILINE)
_LOCKS = ("_el", "_sl")  # held while a process uses it
_GONE_S = 60.0
_YOUNG_S = 60.0  # may be one whose lock is yet to be taken


def strike(leader: int) -> set[str]:
    """SIGKILL to a process group; returns the segments and ports that it had open.

    Not while it makes one: who wants a half-made port waits for it without end, in any domain. And
    they are made, for one, when a node answers another's end: when a graph is killed.
    """
    deadline_s = time.monotonic() + _GONE_S
    opened: set[str] = set()
    with suppress(ProcessLookupError):  # it ended just now, by itself or struck before
        while True:
            os.killpg(leader, signal.SIGSTOP)
            group = _group(leader)
            while not all(_stands(pid) for pid in group):
                time.sleep(0.001)
            opened = {name for pid in group for name in mapped_by(pid) | _opened_by(pid)}
            if not any(_half_made(name) for name in opened) or time.monotonic() > deadline_s:
                break
            os.killpg(leader, signal.SIGCONT)
            time.sleep(0.001)
        os.killpg(leader, signal.SIGKILL)
    return opened


def kill_group(child: Child) -> None:
    """``strike`` on ``child``, and what it so left; no-op where it has ended."""
    if child.poll() is not None:
        return
    opened = strike(child.pid)
    child.wait(timeout=_GONE_S)
    for name in opened:
        if not _held(FOLDER, name):
            _remove(FOLDER, name)


def remove_left_behind(folder: Path = FOLDER) -> list[str]:
    """Removes the segments and ports that no process holds; returns their names."""
    names = [path.name for path in folder.glob("fastrtps_*") if _NAME.fullmatch(path.name)]
    left = sorted(name for name in names if _left(folder, name))
    for name in left:
        _remove(folder, name)
    return left


def _group(leader: int) -> list[int]:
    pids = [int(path.name) for path in Path("/proc").iterdir() if path.name.isdecimal()]
    return [pid for pid in pids if _group_of(pid) == leader]


def _group_of(pid: int) -> int | None:
    try:
        return os.getpgid(pid)
    except ProcessLookupError:
        return None


def mapped_by(pid: int) -> set[str]:
    """The segments and ports that a process has open; none where it is gone."""
    try:
        maps = Path(f"/proc/{pid}/maps").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return set()
    return {match[1] for match in _MAPPED.finditer(maps)}


def _opened_by(pid: int) -> set[str]:
    """As ``mapped_by``, also what is not mapped yet."""
    names = set()
    try:
        for link in Path(f"/proc/{pid}/fd").iterdir():
            path = Path(os.readlink(link))
            if path.parent == FOLDER and _NAME.fullmatch(path.name):
                names.add(path.name)
    except (FileNotFoundError, ProcessLookupError):  # of a process that ended, or of a file closed
        pass
    return names


def _stands(pid: int) -> bool:
    """It is stopped, or has ended."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return True
    return state in "TtZX"


def _half_made(name: str) -> bool:
    """Its first word, which says that it is ready, is still 0."""
    try:
        with (FOLDER / name).open("rb") as segment:
            return not any(segment.read(4))
    except FileNotFoundError:
        return False


def _remove(folder: Path, name: str) -> None:
    for file in (name, *(name + lock for lock in _LOCKS), f"sem.{name}_mutex"):
        (folder / file).unlink(missing_ok=True)


def _left(folder: Path, name: str) -> bool:
    try:
        found = (folder / name).stat()
    except FileNotFoundError:  # removed by its owner meanwhile
        return False
    young = time.time() - found.st_mtime < _YOUNG_S
    return found.st_uid == os.getuid() and not young and not _held(folder, name)


def _held(folder: Path, name: str) -> bool:
    return any(_locked(folder / (name + lock)) for lock in _LOCKS)


def _locked(path: Path) -> bool:
    try:
        opened = os.open(path, os.O_RDWR)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    else:
        return False
    finally:
        os.close(opened)
