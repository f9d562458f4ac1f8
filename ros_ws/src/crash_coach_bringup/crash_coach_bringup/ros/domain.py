"""Reserves a ROS domain that no other Crash Coach process on this machine uses."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Domains whose ports stay below Linux' ephemeral range.
DOMAINS = range(10, 100)


@contextmanager
def reserve_domain() -> Iterator[int]:
    """Yields a domain id, held by a file lock that the kernel releases even on SIGKILL.

    Raises:
        RuntimeError: every domain in DOMAINS is taken.
    """
    folder = Path(tempfile.gettempdir()) / f"crash_coach_domains_{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    for domain in DOMAINS:
        with open(folder / str(domain), "w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield domain
            return
    raise RuntimeError(
        f"no free ROS domain: all of {DOMAINS.start}..{DOMAINS.stop - 1} are reserved in {folder}"
    )
