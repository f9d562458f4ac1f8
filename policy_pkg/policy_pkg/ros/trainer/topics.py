"""A trainer's topics on one graph: episodes come in, weights and blocks go out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from crash_coach_interfaces.msg import (
    Action,
    BlockResult,
    CrashPlan,
    EpisodeState,
    FaultEvent,
    Observation,
    PolicyStatus,
    PolicyWeights,
)
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.serialization import deserialize_message

from crash_coach_common.contract import EnvSpec
from crash_coach_common.ros.qos import BLOCKS, DEEP, DEEP_LATCHED, WEIGHTS, WEIGHTS_STATUS
from policy_pkg.bags.decode import key_of
from policy_pkg.bags.records import Channel
from policy_pkg.bags.topics import TYPES, Kind
from policy_pkg.ros.convert import fault_from_bytes, sensed_from_bytes
from policy_pkg.ros.weights_link import STATUS_TOPIC, WEIGHTS_TOPIC
from policy_pkg.train.live.inbox import Inbox

BLOCKS_TOPIC = "trainer/blocks"
# A sim in lock-step does not wait for this process, whose threads share one interpreter.


@dataclass(frozen=True)
class _Observed:
    features: npt.NDArray[np.float32]
    available_actions: npt.NDArray[np.uint8]


@dataclass(frozen=True)
class _Commanded:
    action: int
    fault: int


class RobotMessages:
    """Decodes what robots' topics carry, faster than by their definitions."""

    def decode(self, channel: Channel, data: bytes) -> Any:
        """Raises UserError for a message that is cut short."""
        if channel.msgtype == TYPES[Kind.COMMAND]:
            return _Commanded(*fault_from_bytes(data))
        sensed = sensed_from_bytes(data)
        return _Observed(sensed.features, sensed.available)


@dataclass(frozen=True)
class Heard:
    """Who wants to know what came: called on the executor's thread."""

    status: Callable[[PolicyStatus], None]
    state: Callable[[EpisodeState], None]
    anything: Callable[[], None]


class TrainerTopics:
    """Files what a graph says in ``inbox``."""

    def __init__(
        self, node: Node, spec: EnvSpec, inbox: Inbox, observation_topic: str, heard: Heard
    ) -> None:
        self._node, self._inbox, self._heard, self._spec = node, inbox, heard, spec
        self._weights = node.create_publisher(PolicyWeights, WEIGHTS_TOPIC, WEIGHTS)
        self._blocks = node.create_publisher(BlockResult, BLOCKS_TOPIC, BLOCKS)
        kinds = {Kind.OBSERVATION: Observation, Kind.COMMAND: Action}
        if observation_topic == Kind.SEEN.value:
            kinds[Kind.SEEN] = Observation
        self._commands = []
        for index, robot in enumerate(spec.robots):
            for kind, message in kinds.items():
                subscription = node.create_subscription(
                    message,
                    f"{robot}/{kind.value}",
                    partial(self._on_robot, kind, index),
                    DEEP,
                    raw=True,
                )
                if kind is Kind.COMMAND:
                    self._commands.append(subscription)
        node.create_subscription(
            EpisodeState, "sim/episode", self._on_state, DEEP_LATCHED, raw=True
        )
        node.create_subscription(CrashPlan, "coach/plan", self._on_plan, DEEP_LATCHED)
        node.create_subscription(FaultEvent, "coach/events", self._on_event, DEEP)
        node.create_subscription(PolicyStatus, STATUS_TOPIC, heard.status, WEIGHTS_STATUS)

    def missing(self, coached: bool) -> list[str]:
        """Robots without anybody who commands them; with ``coached``, a coach that hears blocks."""
        missing = [
            f"{subscription.topic_name} has no publisher"
            for subscription in self._commands
            if subscription.get_publisher_count() == 0
        ]
        if coached and self._blocks.get_subscription_count() == 0:
            missing.append(f"no coach listens to {self._blocks.topic_name}")
        return missing

    def publish_weights(
        self, version: int, from_episode: int, epsilon: float, seed: int, agent: bytes
    ) -> None:
        message = PolicyWeights(
            version=version,
            from_episode=from_episode,
            epsilon=epsilon,
            seed=seed,
            robots=list(self._spec.robots),
            obs_size=self._spec.obs_size,
            n_actions=self._spec.n_actions,
        )
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.agent.frombytes(agent)
        self._weights.publish(message)

    def publish_block(self, block: BlockResult) -> None:
        block.header.stamp = self._node.get_clock().now().to_msg()
        self._blocks.publish(block)

    def block_taken(self) -> bool:
        """Whether every coach has the blocks that were published."""
        return bool(self._blocks.wait_for_all_acked(Duration()))

    def _on_robot(self, kind: Kind, robot: int, data: bytes) -> None:
        number, step = key_of(data)
        self._inbox.add_raw(kind, number, step, robot, data)
        self._heard.anything()

    def _on_state(self, data: bytes) -> None:
        state = deserialize_message(data, EpisodeState)
        self._inbox.add_state(state, data)
        self._heard.state(state)
        self._heard.anything()

    def _on_plan(self, plan: CrashPlan) -> None:
        self._inbox.add_plan(plan)

    def _on_event(self, event: FaultEvent) -> None:
        self._inbox.add_event(event)
        self._heard.anything()
