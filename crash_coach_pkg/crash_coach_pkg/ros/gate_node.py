"""Executable ``gate``: the data plane. Relays what policies want to robots, faulted as planned."""

from __future__ import annotations

import sys

from rclpy.executors import Executor
from rclpy.node import Node

from crash_coach_common.contract import UserError
from crash_coach_common.ros.run_node import spin
from crash_coach_pkg.ros.action_node import ActionGate
from crash_coach_pkg.ros.gate_base import ACTION_TYPE, Gate, GateBase
from crash_coach_pkg.ros.relay_node import RelayGate


def start(executor: Executor) -> Node:
    """A gate on ``executor``."""
    base = GateBase()
    try:
        base.serve(_attach(base))
    except UserError:
        base.destroy_node()
        raise
    executor.add_node(base)
    return base


def _attach(base: GateBase) -> Gate:
    return ActionGate(base) if base.command_type == ACTION_TYPE else RelayGate(base)


def main() -> int:
    return spin(start)


if __name__ == "__main__":
    sys.exit(main())
