"""Who is at the other end of a topic: publishers beside our own, and the QoS that they offer."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from crash_coach_common.ros.peers import UNKNOWN, full_name


class Endpoint(NamedTuple):
    """A publisher on the graph. ``gid`` is unique, ``node`` (with namespace) need not be."""

    gid: str
    node: str

    def __str__(self) -> str:
        return f"{self.node} (gid {self.gid})"


class Sighting(NamedTuple):
    """What changed since the look before."""

    appeared: tuple[Endpoint, ...]
    gone: tuple[Endpoint, ...]


class Stranger(NamedTuple):
    """Somebody on one of the gate's topics whose type is another than the gate's."""

    node: str
    type_name: str


def strangers(node: Node, topic: str, type_name: str, listening: bool) -> tuple[Stranger, ...]:
    """Who publishes on (``listening``: subscribes to) ``topic`` with another type, in order."""
    found = (
        node.get_subscriptions_info_by_topic(topic)
        if listening
        else node.get_publishers_info_by_topic(topic)
    )
    return tuple(
        sorted(
            Stranger(full_name(info), info.topic_type)
            for info in found
            if info.topic_type != type_name
        )
    )


def types_published(node: Node, topics: Iterable[str]) -> frozenset[str]:
    """The types of all publishers on ``topics``."""
    return frozenset(
        info.topic_type for topic in topics for info in node.get_publishers_info_by_topic(topic)
    )


def leaves_observations(node: Node) -> bool:
    """Whether gates are on the graph, and none of them relays observations."""
    gates = [
        (info.node_name, info.node_namespace)
        for info in node.get_publishers_info_by_topic("coach/events")
        if info.node_name != UNKNOWN
    ]
    try:
        types = [
            type_name
            for name, namespace in gates
            for _, names in node.get_publisher_names_and_types_by_node(name, namespace)
            for type_name in names
        ]
    except NodeNameNonExistentError:  # it has just gone
        return False
    return bool(gates) and "crash_coach_interfaces/msg/Observation" not in types


def publishers_on(node: Node, topic: str) -> frozenset[Endpoint]:
    """Every publisher on ``topic`` that the graph knows of now."""
    return frozenset(
        Endpoint(bytes(info.endpoint_gid).hex(), full_name(info))
        for info in node.get_publishers_info_by_topic(topic)
    )


class WatchedPublisher:
    """A publisher of ours, and who else publishes on its topic.

    Ours is known by its gid: a second gate of the same name is an intruder as well.
    """

    def __init__(
        self,
        node: Node,
        type_: type,
        topic: str,
        qos: QoSProfile,
        events: PublisherEventCallbacks | None = None,
    ) -> None:
        self._node = node
        self._name = topic  # remapping is applied to it, not to what comes of that
        before = publishers_on(node, topic)
        self._publisher = node.create_publisher(type_, topic, qos, event_callbacks=events)
        name = node.get_fully_qualified_name()
        # rclpy does not tell a publisher's gid. Our own is on the graph at once, others only
        # after their discovery.
        self._own = {e.gid for e in publishers_on(node, topic) - before if e.node == name}
        self._seen: frozenset[Endpoint] = frozenset()
        self._met: set[str] = set()
        self.topic_name: str = self._publisher.topic_name
        self.publish = self._publisher.publish
        """A message, or its serialized bytes."""
        self.get_subscription_count = self._publisher.get_subscription_count

    @property
    def intruders(self) -> tuple[Endpoint, ...]:
        """As of the last look, in a fixed order."""
        return tuple(sorted(self._seen))

    def _nameless(self, endpoint: Endpoint) -> bool:
        """At the first look at it: a node's name comes a little later than its publishers.

        A publisher that is no ROS node's never has a name.
        """
        if UNKNOWN not in endpoint.node or endpoint.gid in self._met:
            return False
        self._met.add(endpoint.gid)
        return True

    def look(self) -> Sighting:
        """Asks the graph; call at a low rate."""
        found = publishers_on(self._node, self._name)
        now = frozenset(e for e in found if e.gid not in self._own and not self._nameless(e))
        sighting = Sighting(tuple(sorted(now - self._seen)), tuple(sorted(self._seen - now)))
        self._seen = now
        return sighting


@dataclass(frozen=True, slots=True)
class Offer:
    """The strongest service that every publisher on a topic offers."""

    reliability: ReliabilityPolicy
    durability: DurabilityPolicy

    def request(self, depth: int) -> QoSProfile:
        """A subscription that matches them all."""
        return QoSProfile(depth=depth, reliability=self.reliability, durability=self.durability)


def offered(node: Node, topic: str) -> Offer | None:
    """What to subscribe to ``topic`` with; None while nobody publishes on it."""
    profiles: list[Any] = [info.qos_profile for info in node.get_publishers_info_by_topic(topic)]
    if not profiles:
        return None
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
    lasting = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
    return Offer(
        ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        DurabilityPolicy.TRANSIENT_LOCAL if lasting else DurabilityPolicy.VOLATILE,
    )
