"""Where compiled code and logs go that libraries keep: where their own place cannot be written, the
first that can be of $XDG_CACHE_HOME, ~/.cache and the folder for temporary files."""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

NUMBA, MATPLOTLIB, ROS = "NUMBA_CACHE_DIR", "MPLCONFIGDIR", "ROS_LOG_DIR"
FOLDERS = {NUMBA: "numba", MATPLOTLIB: "matplotlib", ROS: "ros_log"}
_NAME = "crash_coach"


def settle_caches(sources: Path) -> None:
    """Sets what of FOLDERS is unset and needs to be set; processes that are started inherit it.

    Call before numba is imported. Says so in one line where the place is a temporary one.

    Args:
        sources: a folder with compiled functions; numba keeps what it compiles beside them.
    """
    wanted = [name for name in FOLDERS if not os.environ.get(name) and not _own(name, sources)]
    if not wanted:
        return
    for base, temporary in _places():
        if _made(base):
            for name in wanted:
                os.environ[name] = str(base / FOLDERS[name])
                (base / FOLDERS[name]).mkdir(exist_ok=True)
            if temporary:
                sys.stderr.write(f"crash-coach: no home to write to: caches and logs in {base}\n")
            return


def places() -> dict[str, str]:
    """What is kept where, for people to read."""
    ros = Path(os.environ.get("ROS_HOME") or _home() / ".ros") / "log"
    return {
        "numba": os.environ.get(NUMBA) or "beside the sources",
        "matplotlib": os.environ.get(MATPLOTLIB) or str(_xdg_cache() / "matplotlib"),
        "ROS logs": os.environ.get(ROS) or str(ros),
    }


def _own(name: str, sources: Path) -> bool:
    """Whether the library's own place can be written to."""
    if name == NUMBA:
        return _writable(sources / "__pycache__")
    if name == MATPLOTLIB:
        config = Path(os.environ.get("XDG_CONFIG_HOME") or _home() / ".config") / "matplotlib"
        return _writable(config) and _writable(_xdg_cache() / "matplotlib")
    return _writable(Path(os.environ.get("ROS_HOME") or _home() / ".ros") / "log")


def _places() -> Iterator[tuple[Path, bool]]:
    yield _xdg_cache() / _NAME, False
    yield Path(tempfile.gettempdir()) / f"{_NAME}_{os.getuid()}", True


def _home() -> Path:
    return Path(os.path.expanduser("~"))


def _xdg_cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or _home() / ".cache")


def _writable(folder: Path) -> bool:
    """Whether ``folder`` is there and writable, or can be made."""
    for place in (folder, *folder.parents):
        if place.exists():
            return place.is_dir() and os.access(place, os.W_OK | os.X_OK)
    return False


def _made(folder: Path) -> bool:
    """Makes ``folder``, for this user alone: numba runs what lies there."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        about = folder.lstat()
    except OSError:
        return False
    own = stat.S_ISDIR(about.st_mode) and about.st_uid == os.getuid()
    return own and not about.st_mode & stat.S_IWOTH and os.access(folder, os.W_OK | os.X_OK)
