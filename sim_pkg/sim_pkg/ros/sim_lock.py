"""At most one sim per ROS domain on a machine."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class SecondSimError(RuntimeError):
    """Another sim runs on this domain."""


@contextmanager
def only_sim(domain: int) -> Iterator[None]:
    """Holds the domain's sim lock: a file lock, which the kernel releases even on SIGKILL.

    DDS discovery cannot tell this: it takes seconds on a busy machine, and lists a killed
    process for 20 s more.

    Raises:
        SecondSimError: another process holds it; names its process id.
    """
    path = Path(tempfile.gettempdir()) / f"crash_coach_sim_{os.getuid()}_{domain}.lock"
    with path.open("a+") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.seek(0)
            raise SecondSimError(
                f"another sim (process {lock.read().strip() or 'unknown'}) runs on ROS domain "
                f"{domain}; stop it, or set another ROS_DOMAIN_ID"
            ) from None
        lock.truncate(0)
        lock.write(str(os.getpid()))
        lock.flush()
        yield
