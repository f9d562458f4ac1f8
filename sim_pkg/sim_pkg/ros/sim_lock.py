"""At most one sim per ROS domain on a machine."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from crash_coach_common.contract import UserError
from crash_coach_common.locks import TakenError, held


class SecondSimError(UserError):
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
    try:
        with held(path):
            yield
    except TakenError as error:
        raise SecondSimError(
            f"another sim ({error}) runs on ROS domain {domain}; stop it, or set another "
            "ROS_DOMAIN_ID"
        ) from None
