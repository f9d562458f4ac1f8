"""Runs of a sweep on this machine: one single-threaded process each."""

from __future__ import annotations

import os

from policy_pkg.sweep.sweep import Ended
from policy_pkg.sweep.task import Child, Task


class LocalEngine:
    """At most ``slots`` processes at a time."""

    def __init__(self, slots: int | None = None) -> None:
        self.slots = slots or len(os.sched_getaffinity(0))
        self._children: dict[str, Child] = {}

    def start(self, task: Task) -> None:
        """Raises OSError."""
        self._children[task.name] = Child(task)

    def poll(self) -> list[Ended]:
        ended = []
        for name, child in list(self._children.items()):
            code = child.poll()
            if code is not None:
                del self._children[name]
                ended.append(Ended(name, None if code == 0 else child.failure()))
        return ended

    def stop(self) -> None:
        for child in self._children.values():
            child.terminate()
        for child in self._children.values():
            child.stop()
        self._children.clear()
