"""At most one sim per ROS domain and namespace on a machine."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from crash_coach_common.contract import UserError
from crash_coach_common.locks import TakenError, held


class SecondSimError(UserError):
    """Another sim runs on this domain, in the same namespace."""


@contextmanager
def only_sim(domain: int, namespace: str = "/") -> Iterator[None]:
    """Holds the lock of the domain's namespace: a file's, which the kernel releases on SIGKILL too.

    DDS discovery cannot tell this: it takes seconds on a busy machine, and lists a killed
    process for 20 s more.

    Raises:
        SecondSimError: another process holds it; names its process id.
    """
    # No name has a dot in it, so that different namespaces have different files.
    place = ".".join(part for part in namespace.split("/") if part)
    name = f"crash_coach_sim_{os.getuid()}_{domain}{place and '.'}{place}.lock"
    try:
        with held(Path(tempfile.gettempdir()) / name):
            yield
    except TakenError as error:
        where = f"{domain}, namespace {namespace}" if place else f"{domain}"
        raise SecondSimError(
            f"another sim ({error}) runs on ROS domain {where}; stop it, or set another "
            "ROS_DOMAIN_ID"
        ) from None
