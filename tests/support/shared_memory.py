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

import psutil

from crash_coach_bringup.ros.shared_memory import NAME, is_ready
from crash_coach_bringup.ros.shared_memory import SHARED_MEMORY as FOLDER

if TYPE_CHECKING:
    from node_process import Child

_MAPPED = re.compile(rf"{FOLDER}/({NAME.pattern})$", re.MULTILINE)
_STANDING = (psutil.STATUS_STOPPED, psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
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
            while not all(map(_stands, group)) and time.monotonic() < deadline_s:
                time.sleep(0.001)
            opened = {name for pid in group for name in mapped_by(pid) | _opened_by(pid)}
            if not any(_in_the_making(name) for name in opened) or time.monotonic() > deadline_s:
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
    names = [path.name for path in folder.glob("fastrtps_*") if NAME.fullmatch(path.name)]
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
    try:
        opened = [Path(file.path) for file in psutil.Process(pid).open_files()]
    except psutil.NoSuchProcess:
        return set()
    return {path.name for path in opened if path.parent == FOLDER and NAME.fullmatch(path.name)}


def _stands(pid: int) -> bool:
    """It is stopped, or has ended."""
    try:
        return psutil.Process(pid).status() in _STANDING
    except psutil.NoSuchProcess:
        return True


def _in_the_making(name: str) -> bool:
    try:
        return not is_ready(FOLDER / name)
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
