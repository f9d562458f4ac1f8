"""What executables share: parameters checked at start, an executor, an end by signal."""

from __future__ import annotations

import gc
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor
from rclpy.experimental import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions

from crash_coach_common.contract import UserError

NEWEST = QoSProfile(depth=1)  # reliable: an observation or command replaces the one before
PLAN = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
EVENTS = QoSProfile(depth=1000)  # on a busy machine readers may be that far behind
BLOCKS = QoSProfile(depth=10)
EPISODE = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SPIN_S = 0.1  # how soon a signal is noticed
TICK_S = 0.05  # steady timers for leases and heartbeats
RCLError: type[Exception] = rclpy_implementation.RCLError  # bad --ros-args, for one


def refuse_unknown_parameters(node: Node) -> None:
    """Raises UserError for a parameter given at start that the node has not declared."""
    known = ", ".join(sorted(node._parameters))
    for name in node._parameter_overrides:
        if not node.has_parameter(name):
            raise UserError(f"unknown parameter {name!r} of {node.get_name()}; known: {known}")


def spin(start: Callable[[Executor], Node]) -> int:
    """Runs what ``start`` puts on the executor until SIGINT or SIGTERM.

    Returns the exit code: 1 after one line of error on stderr, otherwise 0.
    """
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, note)
    executor = node = None
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        executor = EventsExecutor()
        node = start(executor)
        gc.freeze()  # what was loaded so far stays: no collection need look at it again
        while not received:
            executor.spin_once(timeout_sec=SPIN_S)
    except (UserError, ParameterException, RCLError) as error:
        program = Path(sys.argv[0]).name
        print(f"{program}: error: {error}", file=sys.stderr)  # noqa: T201
        return 1
    finally:
        # In this order: DDS must not call back into what is gone (the executor first lets go).
        if executor is not None:
            executor.shutdown()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0
