"""Decentralised QMIX agents: acting (numpy), training (torch, under learner/), and ROS 2 nodes."""

from pathlib import Path

from crash_coach_common.caches import settle_caches
from policy_pkg.kernels import pin_kernels

pin_kernels()
settle_caches(Path(__file__).parent)
