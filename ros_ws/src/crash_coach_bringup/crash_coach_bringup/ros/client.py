"""A short-lived node that talks to a running graph; every wait is bounded and says its aim."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.task import Future

from crash_coach_bringup.ros.discovery import use_quick_discovery
from crash_coach_common.contract import UserError

SPIN_S = 0.05
ASK_AGAIN_S = 0.3


class WaitError(UserError):
    """What was waited for did not come in time."""


class GraphClient:
    """A node with its own context and executor; ``check`` raises when waiting became useless."""

    def __init__(self, node: Node, context: Context, check: Callable[[], None]) -> None:
        self.node = node
        self._check = check
        self._executor = EventsExecutor(context=context)
        self._executor.add_node(node)

    def close(self) -> None:
        """The executor lets go before the node goes: DDS must not call back into what is gone."""
        self._executor.shutdown()
        self.node.destroy_node()

    def until(self, ready: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Serves the node's callbacks until ``ready()``. Raises WaitError naming ``what``."""
        deadline = time.monotonic() + timeout_s
        while not ready():
            self._check()
            left_s = deadline - time.monotonic()
            if left_s <= 0:
                raise WaitError(f"waited {timeout_s:g} s for {what}")
            self._executor.spin_once(timeout_sec=min(SPIN_S, left_s))

    def pause(self, duration_s: float) -> None:
        """Serves the node's callbacks for a while."""
        end = time.monotonic() + duration_s
        while (left_s := end - time.monotonic()) > 0:
            self._check()
            self._executor.spin_once(timeout_sec=min(SPIN_S, left_s))

    def greet(self, target: str, timeout_s: float, what: str) -> None:
        """Makes sure that node ``target`` knows this one; see ``greet``. Raises WaitError."""

        def spin_once(spin_s: float) -> None:
            self._check()
            self._executor.spin_once(timeout_sec=spin_s)

        greet(self.node, target, spin_once, timeout_s, what)

    def result(self, future: Future, timeout_s: float, what: str) -> Any:
        """The result of a service call. Raises WaitError naming ``what``."""
        self.until(future.done, timeout_s, what)
        return future.result()


def greet(
    node: Node, target: str, spin_once: Callable[[float], None], timeout_s: float, what: str
) -> None:
    """Returns when ``target`` has answered ``node``: then no later call or answer can be lost.

    A service is "ready" as soon as this side has found it. Until the other side has found this
    one as well, a request is dropped and an answer goes nowhere. A node announces its endpoints
    in the order in which they were made, so once the client made last, here, has an answer, all
    that were made before it are known too. The question changes nothing and may be repeated.

    Raises:
        WaitError: no answer in ``timeout_s``; names ``what``.
    """
    client = node.create_client(GetParameters, f"{target}/get_parameters")
    deadline = time.monotonic() + timeout_s
    while True:
        answer = client.call_async(GetParameters.Request()) if client.service_is_ready() else None
        again = time.monotonic() + ASK_AGAIN_S
        while (now := time.monotonic()) < min(again, deadline):
            if answer is not None and answer.done():
                node.destroy_client(client)
                return
            spin_once(min(SPIN_S, deadline - now))
        if now >= deadline:
            raise WaitError(f"waited {timeout_s:g} s for {what}")


@contextmanager
def graph_client(
    name: str, domain: int | None = None, check: Callable[[], None] = lambda: None
) -> Iterator[GraphClient]:
    """A client on ``domain`` (None: the environment's), independent of rclpy's global state."""
    use_quick_discovery()
    context = Context()
    context.init(args=[], domain_id=domain)
    try:
        node = Node(name, context=context, use_global_arguments=False)
        client = GraphClient(node, context, check)
        try:
            yield client
        finally:
            client.close()
    finally:
        context.try_shutdown()
