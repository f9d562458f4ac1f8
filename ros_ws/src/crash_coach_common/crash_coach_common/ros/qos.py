"""The qualities of service of this project's topics."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, QoSProfile

NEWEST = QoSProfile(depth=1)  # reliable: an observation or command replaces the one before
PLAN = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
EVENTS = QoSProfile(depth=1000)  # on a busy machine readers may be that far behind
BLOCKS = QoSProfile(depth=10)
EPISODE = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
