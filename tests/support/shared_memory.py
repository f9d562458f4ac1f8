"""What killed nodes left of Fast DDS in shared memory: who takes their port later waits for it."""

from __future__ import annotations

import fcntl
import os
import re
import signal
import time
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


def kill_group(child: Child) -> None:
    """SIGKILL to ``child``'s process group, and what it so left; no-op where it has ended."""
    if child.poll() is not None:
        return
    mapped = {name for pid in _group(child.pid) for name in mapped_by(pid)}
    os.killpg(child.pid, signal.SIGKILL)
    child.wait(timeout=_GONE_S)
    for name in mapped:
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
