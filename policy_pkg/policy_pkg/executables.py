"""The executables of this package, by their names."""

from __future__ import annotations

from crash_coach_common.executable import run


def policy() -> int:
    return run("policy_pkg.ros.policy_node")


def recorder() -> int:
    return run("policy_pkg.ros.recorder_node")


def team() -> int:
    return run("policy_pkg.ros.team_node")


def trainer() -> int:
    return run("policy_pkg.ros.trainer.node")
