"""Multi-robot simulator on pymunk: scenarios, a batch of arenas, and its ROS 2 node."""

from pathlib import Path

from crash_coach_common.caches import settle_caches

settle_caches(Path(__file__).parent)
