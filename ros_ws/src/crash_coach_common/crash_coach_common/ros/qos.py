"""The qualities of service of this project's topics."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, QoSProfile


def latched(depth: int = 1) -> QoSProfile:
    """Reliable; whoever comes later gets the last ``depth`` messages."""
    return QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)


NEWEST = QoSProfile(depth=1)  # reliable: an observation or command replaces the one before
PLAN = latched()
EVENTS = QoSProfile(depth=1000)  # on a busy machine readers may be that far behind
BLOCKS = QoSProfile(depth=10)
EPISODE = latched(10)
EVERY_EPISODE = latched(1000)  # for readers that miss none, though the sim began before them
ARENA = latched()
WEIGHTS = latched()
WEIGHTS_STATUS = latched(1000)
# What may wait for a process that records everything, while it is not scheduled.
DEEP = QoSProfile(depth=2000)
DEEP_LATCHED = latched(2000)
