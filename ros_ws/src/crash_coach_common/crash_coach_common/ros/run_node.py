"""What executables share: an end by signal, one line of error, nodes served and let go in order."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TypeVar

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor
from rclpy.experimental import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from crash_coach_common.caches import settle_caches
from crash_coach_common.contract import UserError
from crash_coach_common.ros.qos_node import tell_unused

SPIN_S = 0.1  # how soon a signal or an end is noticed
TICK_S = 0.05  # steady timers for leases and heartbeats
RCLError: type[Exception] = rclpy_implementation.RCLError  # bad --ros-args, for one

NodeT = TypeVar("NodeT", bound=Node)


def run(body: Callable[[list[int]], None], program: str | None = None) -> int:
    """Calls ``body`` between rclpy's start and end.

    Args:
        body: gets a list that SIGINT and SIGTERM are added to; it is to look at it often.
        program: what errors begin with; None: the executable's name.

    Returns the exit code: 1 after one line of error on stderr, or where nobody reads what is
    printed any more; otherwise 0.
    """
    settle_caches(Path(__file__).parent)
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, note)
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        body(received)
    except (UserError, ParameterException, RCLError) as error:
        print(f"{program or Path(sys.argv[0]).name}: error: {error}", file=sys.stderr)  # noqa: T201
        return 1
    except BrokenPipeError:
        # Whoever read what is printed is gone; nor must Python fail on it once more at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    finally:
        rclpy.try_shutdown()
    return 0


class Serving:
    """An executor and its nodes; ``start`` adds one."""

    def __init__(self) -> None:
        self.executor = EventsExecutor()
        self._nodes: list[Node] = []

    def add(self, node: NodeT) -> NodeT:
        self._nodes.append(node)
        self.executor.add_node(node)
        return node

    def start(self, start: Callable[[Executor], NodeT]) -> NodeT:
        """``start`` makes a node and puts it on the executor."""
        node = start(self.executor)
        self._nodes.append(node)
        return node

    def until(self, done: Callable[[], object]) -> None:
        """Serves until ``done()``, asked every SPIN_S, which may raise what went wrong."""
        tell_unused(self._nodes)
        gc.freeze()  # what was loaded so far stays: no collection need look at it again
        never: Future[None] = Future(executor=self.executor)
        while not done():
            # Many callbacks at a time: between two of them nothing of Python's runs.
            self.executor.spin_until_future_complete(never, timeout_sec=SPIN_S)

    def close(self) -> None:
        # In this order: DDS must not call back into what is gone (the executor first lets go).
        self.executor.shutdown()
        for node in self._nodes:
            node.destroy_node()


@contextmanager
def serving() -> Iterator[Serving]:
    """Nodes of this process, gone when the block is left."""
    served = Serving()
    try:
        yield served
    finally:
        served.close()


def spin(start: Callable[[Executor], Node]) -> int:
    """An executable of one node, until SIGINT or SIGTERM; returns as ``run``."""

    def body(received: list[int]) -> None:
        with serving() as served:
            served.start(start)
            served.until(lambda: received)

    return run(body)
