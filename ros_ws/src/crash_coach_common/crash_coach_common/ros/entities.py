"""Taking an entity away from a node that goes on."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.subscription import Subscription


def destroy_subscription(node: Node, subscription: Subscription) -> None:
    """As rclpy's, but safe while EventsExecutor serves the node.

    That hands an event of the middleware that is already under way (a publisher whose quality of
    service does not fit) to its handler all the same, which raises InvalidHandle out of the
    executor: the end of the node. Messages, services and clients it looks up first.
    """
    for handler in subscription.event_handlers:
        handler.take_data = _nothing
    node.destroy_subscription(subscription)


def _nothing() -> None:
    """There is no event any more."""
