"""Programs beside a test that have to live as long as it needs them."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from shared_memory import kill_group


@contextmanager
def kept_running(
    command: Sequence[str], env: dict[str, str], folder: Path | None = None
) -> Iterator[None]:
    """A program in its own session that must not end by itself, gone when the block is left."""
    child = subprocess.Popen(command, env=env, cwd=folder, start_new_session=True)
    try:
        yield
        assert child.poll() is None, f"it ended: {' '.join(command)}"
    finally:
        kill_group(child)
