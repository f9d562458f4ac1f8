"""The executables of this package, by their names."""

from __future__ import annotations

from crash_coach_common.executable import run


def sim() -> int:
    return run("sim_pkg.ros.sim_node")
