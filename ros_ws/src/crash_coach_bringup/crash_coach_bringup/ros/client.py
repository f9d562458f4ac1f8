"""A short-lived node that talks to a running graph; every wait is bounded and says its aim."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.task import Future

from crash_coach_bringup.ros.discovery import use_quick_discovery
from crash_coach_bringup.ros.domain import check_domain
from crash_coach_bringup.ros.namespaces import checked_namespace
from crash_coach_common.ros.greet import SPIN_S, WaitError, greet


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


@contextmanager
def graph_client(
    name: str,
    domain: int | None = None,
    check: Callable[[], None] = lambda: None,
    namespace: str = "",
) -> Iterator[GraphClient]:
    """A client on ``domain`` (None: the environment's), independent of rclpy's global state.

    ``namespace``: that relative names of topics, services and nodes are in.

    Raises:
        UserError: a domain or a namespace that does not exist.
    """
    number = check_domain(domain)
    use_quick_discovery()
    context = Context()
    context.init(args=[], domain_id=number)
    try:
        node = Node(
            name,
            context=context,
            namespace=checked_namespace(namespace) or None,
            use_global_arguments=False,
        )
        client = GraphClient(node, context, check)
        try:
            yield client
        finally:
            client.close()
    finally:
        context.try_shutdown()
