"""A subscription is taken away while events of it are under way."""

from __future__ import annotations

import time

import rclpy
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_common.ros.entities import destroy_subscription

BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


def test_an_event_that_is_under_way_harms_nobody() -> None:
    """rclpy's own way ends in InvalidHandle, and a gate with it."""
    context = Context()
    with reserve_domain() as domain:
        rclpy.init(context=context, domain_id=domain)
        node = rclpy.create_node("one", context=context)
        other = rclpy.create_node("other", context=context)
        executor = EventsExecutor(context=context)
        executor.add_node(node)
        got: list[String] = []
        subscription = node.create_subscription(String, "topic", got.append, 10)
        for _ in range(5):
            executor.spin_once(timeout_sec=0.01)  # the executor learns of it
        publisher = other.create_publisher(String, "topic", BEST_EFFORT)
        time.sleep(0.5)  # the event waits: nobody spins
        destroy_subscription(node, subscription)
        node.create_subscription(String, "topic", got.append, BEST_EFFORT)
        end = time.monotonic() + 30.0
        while not got:
            assert time.monotonic() < end
            publisher.publish(String(data="after"))
            executor.spin_once(timeout_sec=0.05)
        executor.shutdown()
        node.destroy_node()
        other.destroy_node()
        rclpy.shutdown(context=context)
