"""A node on whose topics ``qos_overrides.<topic>.<publisher or subscription>.<policy>`` count.

rclpy lets a node say, topic by topic, which policies may be overridden, and declares a parameter
for each. Here all may be, and only what is overridden has a parameter: a team has many topics.
"""

from __future__ import annotations

from collections.abc import Iterable
from copy import copy
from typing import Any, Literal

import rclpy.qos
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from crash_coach_common.contract import UserError
from crash_coach_common.strict_yaml import did_you_mean

PREFIX = "qos_overrides."
Entity = Literal["publisher", "subscription"]
_ENTITIES = ("publisher", "subscription")
_POLICIES = {kind.name.lower(): kind for kind in QoSPolicyKind if kind is not QoSPolicyKind.INVALID}
_WORDS = {
    "durability": rclpy.qos.DurabilityPolicy,
    "history": rclpy.qos.HistoryPolicy,
    "liveliness": rclpy.qos.LivelinessPolicy,
    "reliability": rclpy.qos.ReliabilityPolicy,
}
_FLAG = "avoid_ros_namespace_conventions"
_used: set[str] = set()  # of all nodes of this process, which are given each other's


class QosNode(Node):
    """Raises UserError where an override cannot be read."""

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        for parameter in overrides(self):
            _check(parameter)

    def create_publisher(
        self, msg_type: type, topic: str, qos_profile: QoSProfile | int, **options: Any
    ) -> Publisher:
        qos, asked = _asked(self, topic, "publisher", qos_profile)
        return super().create_publisher(
            msg_type, topic, qos, qos_overriding_options=asked, **options
        )

    def create_subscription(
        self, msg_type: type, topic: str, callback: Any, qos_profile: QoSProfile | int, **more: Any
    ) -> Subscription:
        qos, asked = _asked(self, topic, "subscription", qos_profile)
        return super().create_subscription(
            msg_type, topic, callback, qos, qos_overriding_options=asked, **more
        )


def overrides(node: Node) -> list[Parameter]:
    """All that the node was started with, for its topics and for others'."""
    # rclpy makes a publisher of its own before it has read them.
    given: dict[str, Parameter] = getattr(node, "_parameter_overrides", {})
    return [parameter for name, parameter in given.items() if name.startswith(PREFIX)]


def overridden(node: Node, topic: str, entity: Entity) -> tuple[str, ...]:
    """The policies of ``topic`` that were overridden for the node."""
    begin = _begin(node, topic, entity)
    names = [parameter.name for parameter in overrides(node)]
    return tuple(name.removeprefix(begin) for name in names if name.startswith(begin))


def _begin(node: Node, topic: str, entity: Entity) -> str:
    return f"{PREFIX}{node.resolve_topic_name(topic)}.{entity}."


def tell_unused(nodes: Iterable[Node]) -> None:
    """Logs overrides for topics that none of ``nodes``, all of a process, has opened so far."""
    for node in nodes:
        for name in sorted({parameter.name for parameter in overrides(node)} - _used):
            _used.add(name)  # told once
            node.get_logger().warning(f"{name} has no effect so far: no such topic is open here")


def _asked(
    node: Node, topic: str, entity: Entity, qos: QoSProfile | int
) -> tuple[QoSProfile | int, QoSOverridingOptions]:
    policies = overridden(node, topic, entity)
    _used.update(_begin(node, topic, entity) + policy for policy in policies)
    # rclpy changes the profile, of which others have the same object.
    own = qos if isinstance(qos, int) else copy(qos)
    return own, QoSOverridingOptions([_POLICIES[policy] for policy in policies])


def _check(parameter: Parameter) -> None:
    name, value = parameter.name, parameter.value
    rest, _, policy = name.rpartition(".")
    entity = rest.rpartition(".")[2]
    if entity not in _ENTITIES or policy not in _POLICIES:
        known = _POLICIES if entity in _ENTITIES else _ENTITIES
        wrong = policy if entity in _ENTITIES else entity
        raise UserError(
            f"parameter {name}: {wrong!r} is none of {', '.join(known)}"
            f"{did_you_mean(wrong, known)}; must be {PREFIX}/the/topic.publisher.depth, for one"
        )
    if entity == "subscription" and policy == "lifespan":
        raise UserError(f"parameter {name}: a subscription has no lifespan")
    if policy in _WORDS:
        words = [word.lower() for word in _WORDS[policy].__members__ if word != "UNKNOWN"]
        if value not in words:
            raise UserError(f"parameter {name} = {value!r}; one of: {', '.join(words)}")
    elif policy == _FLAG:
        if not isinstance(value, bool):
            raise UserError(f"parameter {name} = {value!r}: must be true or false")
    elif isinstance(value, bool) or not isinstance(value, int) or value < 0:
        unit = "" if policy == "depth" else ", nanoseconds"
        raise UserError(f"parameter {name} = {value!r}: must be a number from 0 on{unit}")
