"""Reserves a ROS domain that no other Crash Coach process on this machine uses."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from crash_coach_common.contract import UserError
from crash_coach_common.locks import TakenError, held

# Domains whose ports stay below Linux' ephemeral range.
DOMAINS = range(10, 100)


LIMIT = 232  # rmw: higher ids have no valid UDP ports


def check_domain(domain: int | None) -> int:
    """``domain``, or for None the environment's. Raises UserError for one that does not exist."""
    text = os.environ.get("ROS_DOMAIN_ID", "") if domain is None else str(domain)
    try:
        found = int(text or "0")
    except ValueError:
        raise UserError(f"ROS_DOMAIN_ID is {text!r}, not a number") from None
    if not 0 <= found <= LIMIT:
        raise UserError(f"ROS domain {found} is not in 0..{LIMIT}")
    return found


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
