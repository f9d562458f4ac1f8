"""Makes sure that a node is known to another, so that no call and no answer is lost."""

from __future__ import annotations

import time
from collections.abc import Callable

from rcl_interfaces.srv import GetParameters
from rclpy.node import Node

from crash_coach_common.contract import UserError

SPIN_S = 0.05
ASK_AGAIN_S = 0.3


class WaitError(UserError):
    """What was waited for did not come in time."""


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
