"""Outputs onto any kind of path: plain files whole or not at all, the others written to.

A symbolic link is followed. What is no plain file, such as a pipe or a terminal, is never replaced.
Folders that are missing on the way are made.
"""

from __future__ import annotations

import errno
import itertools
import os
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

READER_S = 10.0  # how long a pipe may be without a reader
_POLL_S = 0.05
_NUMBERS = itertools.count()


def kind_of(mode: int) -> str:
    """'file', 'folder', 'stream' (a pipe or a character device) or 'disk', of a stat's mode."""
    if stat.S_ISREG(mode):
        return "file"
    if stat.S_ISDIR(mode):
        return "folder"
    return "disk" if stat.S_ISBLK(mode) else "stream"


def check_output(path: Path) -> None:
    """Raises OSError where ``whole_output`` could not write to ``path``, as far as can be told."""
    kind, target = _look(path)
    if kind != "file" or _standard_stream(target) is not None:
        return
    check_folder(target.parent, path)


def check_folder(folder: Path, path: Path) -> None:
    """Raises OSError about ``path`` where ``folder`` is not there and cannot be made."""
    while not os.path.lexists(folder):
        folder = folder.parent
    if not folder.is_dir():
        raise OSError(errno.ENOTDIR, f"{folder} is not a folder", str(path))
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OSError(errno.EACCES, f"the folder {folder} cannot be written to", str(path))


@contextmanager
def folder_made(folder: Path) -> Iterator[None]:
    """``folder`` is there for the body; what had to be made goes again where the body fails."""
    missing = [each for each in (folder, *folder.parents) if not os.path.lexists(each)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for each in missing:
            with suppress(OSError):
                each.rmdir()
        raise


@contextmanager
def whole_output(path: Path) -> Iterator[Path]:
    """A plain file to write to, of the same suffix; its content is at ``path`` once all went well.

    Raises:
        OSError: a folder or a disk is there, nobody reads the pipe, or it cannot be written.
    """
    kind, target = _look(path)
    stream = _standard_stream(target) if kind == "file" else None
    if kind == "file" and stream is None:
        temporary = target.with_name(f".{os.getpid()}.{next(_NUMBERS)}{target.suffix}")
        with folder_made(target.parent):
            try:
                yield temporary
                with suppress(FileNotFoundError):
                    temporary.chmod(stat.S_IMODE(target.stat().st_mode))
                temporary.replace(target)
            finally:
                # On a read-only disk this fails too, and says less than what went wrong first.
                with suppress(OSError):
                    temporary.unlink()
        return
    with tempfile.TemporaryDirectory(prefix="crash_coach_") as folder:
        temporary = Path(folder) / f"output{path.suffix}"
        yield temporary
        with temporary.open("rb") as content, _opened(target, stream) as out:
            shutil.copyfileobj(content, out)


def write_whole(path: Path, content: bytes) -> None:
    """Writes ``content``. Raises OSError as ``whole_output``."""
    with whole_output(path) as temporary:
        temporary.write_bytes(content)


def _look(path: Path) -> tuple[str, Path]:
    """What is at ``path``, and where that is. Raises OSError for a folder or a disk."""
    try:
        kind = kind_of(path.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        kind = "file"  # a new one, also where a link leads to
    if kind == "folder":
        raise OSError(errno.EISDIR, "is a directory", str(path))
    if kind == "disk":
        raise OSError(errno.EPERM, "is a disk, which is not written over", str(path))
    # What a stream's link in /proc leads to is no path.
    return kind, Path(os.path.realpath(path)) if kind == "file" else path


def _standard_stream(path: Path) -> int | None:
    """Whether this process' output goes to that very file already: its descriptor."""
    for number in (1, 2):
        with suppress(OSError):
            if os.path.samestat(path.stat(), os.fstat(number)):
                return number
    return None


@contextmanager
def _opened(path: Path, stream: int | None) -> Iterator[BinaryIO]:
    if stream is not None:
        sys.stdout.flush()
        with os.fdopen(os.dup(stream), "wb") as out:
            yield out
        return
    with os.fdopen(_read_by_somebody(path), "wb") as out:
        yield out


def _read_by_somebody(path: Path) -> int:
    """Opens a stream for writing. Raises OSError where a pipe has no reader for READER_S."""
    for left in reversed(range(round(READER_S / _POLL_S))):
        try:
            descriptor = os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
        except OSError as error:
            if error.errno != errno.ENXIO:
                raise
            if not left:
                raise OSError(errno.ENXIO, "nobody reads from it", str(path)) from None
            time.sleep(_POLL_S)
        else:
            os.set_blocking(descriptor, True)
            return descriptor
    raise AssertionError("unreachable")
