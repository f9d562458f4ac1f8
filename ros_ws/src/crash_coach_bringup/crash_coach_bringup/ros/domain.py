"""Reserves a ROS domain that no other Crash Coach process on this machine uses."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from crash_coach_common.locks import TakenError, held

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
        with ExitStack() as stack:
            try:
                stack.enter_context(held(folder / str(domain)))
            except TakenError:
                continue
            yield domain
            return
    raise RuntimeError(
        f"no free ROS domain: all of {DOMAINS.start}..{DOMAINS.stop - 1} are reserved in {folder}"
    )
