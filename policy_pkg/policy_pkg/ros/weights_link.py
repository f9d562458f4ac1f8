"""A policy node's side of live training: takes weights, says which it holds."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from crash_coach_interfaces.msg import PolicyStatus, PolicyWeights
from rclpy.node import Node

from crash_coach_common.contract import UserError
from crash_coach_common.ros.qos import WEIGHTS, WEIGHTS_STATUS, latched
from policy_pkg.agent import Answer, Sensed
from policy_pkg.live_weights import LiveAgent, Weights

WEIGHTS_TOPIC = "trainer/weights"
STATUS_TOPIC = "trainer/policies"
Receive = Callable[[int, Sensed[bytes]], list[Answer[bytes]]]


class WeightsLink:
    """Subscribes to /trainer/weights on ``node``.

    Args:
        robots: for whom to act; empty: for the whole team, which the weights name.
        act_for: called once, with the first weights: robots, and what answers their observations.
    """

    def __init__(
        self,
        node: Node,
        robots: tuple[str, ...],
        act_for: Callable[[tuple[str, ...], Receive], None],
    ) -> None:
        self._node, self._robots, self._act_for = node, robots, act_for
        self._live: LiveAgent[bytes] | None = None
        # The last word of every robot that this node drives.
        depth = max(1, len(robots)) if robots else WEIGHTS_STATUS.depth
        self._status = node.create_publisher(PolicyStatus, STATUS_TOPIC, latched(depth))
        node.create_subscription(PolicyWeights, WEIGHTS_TOPIC, self._on_weights, WEIGHTS)

    def _on_weights(self, message: PolicyWeights) -> None:
        try:
            weights = read_weights(message)
            if self._live is None:
                self._live = LiveAgent(weights, self._robots)
                self._act_for(self._live.agent.robots, self._receive)
            else:
                self._live.offer(weights)
        except UserError as error:
            # A robot goes on with what it has; the trainer sees that nobody confirmed these.
            self._node.get_logger().error(f"{error}; ignored")
            return
        self._confirm(weights.version, self._live.agent.robots)

    def _confirm(self, version: int, robots: Sequence[str]) -> None:
        status = PolicyStatus(version=version)
        status.header.stamp = self._node.get_clock().now().to_msg()
        for robot in robots:
            status.robot = robot
            self._status.publish(status)

    def _receive(self, robot: int, sensed: Sensed[bytes]) -> list[Answer[bytes]]:
        assert self._live is not None  # nobody observes before the first weights
        if sensed.step == 0:
            self._live.begin(sensed.episode)
        return self._live.agent.receive(robot, sensed)


def read_weights(message: PolicyWeights) -> Weights:
    """Raises UserError as Weights.read."""
    return Weights.read(
        message.version,
        message.from_episode,
        message.epsilon,
        message.seed,
        tuple(message.robots),
        message.obs_size,
        message.n_actions,
        bytes(message.agent),
    )
