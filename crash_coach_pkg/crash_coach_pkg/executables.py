"""The executables of this package, by their names."""

from __future__ import annotations

from crash_coach_common.executable import run


def coach() -> int:
    return run("crash_coach_pkg.ros.coach_node")


def gate() -> int:
    return run("crash_coach_pkg.ros.gate_node")
