"""What Fast DDS keeps in shared memory, and what killed nodes left half-made there."""

from __future__ import annotations

import re
import time
from pathlib import Path

SHARED_MEMORY = Path("/dev/shm")
NAME = re.compile(r"fastrtps_(port\d+|[0-9a-f]{16})")
"""Of a port or a segment; its locks' names are longer."""

_MADE_WITHIN_S = 2.0


def is_ready(path: Path) -> bool:
    """Whether its maker was done: its first word, 0 until then, says so.

    Raises:
        OSError: it cannot be read, or is gone.
    """
    with path.open("rb") as segment:
        return any(segment.read(4))


def half_made(folder: Path) -> list[Path]:
    """Ports and segments whose maker was killed before they were ready, sorted.

    Fast DDS waits without end, in every domain, for one that never is.
    """
    found = []
    for path in sorted(folder.glob("fastrtps_*")):
        if not NAME.fullmatch(path.name):
            continue
        try:
            age_s = time.time() - path.stat().st_mtime
            ready = is_ready(path)
        except (FileNotFoundError, PermissionError):  # removed meanwhile; another user's
            continue
        if not ready and age_s > _MADE_WITHIN_S:
            found.append(path)
    return found
