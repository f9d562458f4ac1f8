"""What robots have each a topic of, in one message where nobody minds: fewer wake-ups per step.

Whoever listens to the team's hidden topic as well as to the robots' own needs each robot's message
on only one of them. So a robot's message goes out on its own topic as soon as some other node
listens to that, and with the rest of the team otherwise: every listener hears it once. Whoever has
overridden the quality of service of a robot's own topic gets that topic.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

from crash_coach_interfaces.msg import Action, Observation, TeamAction, TeamObservation
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from crash_coach_common.contract import UserError
from crash_coach_common.ros.peers import UNKNOWN, full_name
from crash_coach_common.ros.qos import NEWEST
from crash_coach_common.ros.qos_node import overridden
from crash_coach_common.team_cdr import (
    Layout,
    RobotMessage,
    TeamCodec,
    action_layout,
    observation_layout,
)

NAMESPACE = "_team"  # hidden: a bag of all topics then has the robots' own, as bags always had
_LOOK_S = 1.0  # a node's name may come later than its subscriptions


@dataclass(frozen=True)
class Kind:
    """What the messages are."""

    what: str
    robot_type: type
    team_type: type
    layout: Layout

    def codec(self, robots: Sequence[str]) -> TeamCodec:
        return TeamCodec(self.what, robots, self.layout)


COMMANDS = Kind("team's commands", Action, TeamAction, action_layout)
OBSERVATIONS = Kind("team's observations", Observation, TeamObservation, observation_layout)


class RobotPublisher(Protocol):
    """Of a robot's own topic."""

    @property
    def topic_name(self) -> str: ...

    def publish(self, message: bytes) -> None: ...

    def get_subscription_count(self) -> int: ...


class TeamPublisher:
    """Publishes the messages of ``robots``.

    Args:
        topics: of each robot, as written: remapping still applies.
        name: of the team's topic, within NAMESPACE.
        make: makes a robot's publisher, by its index; to be told of who comes and goes.
    """

    def __init__(
        self,
        node: Node,
        kind: Kind,
        robots: Sequence[str],
        topics: Sequence[str],
        name: str,
        make: Callable[[int, PublisherEventCallbacks], RobotPublisher] | None = None,
    ) -> None:
        self._node, self._topics = node, tuple(topics)
        self._codec = kind.codec(robots)
        self.together: frozenset[int] = frozenset()
        """Robots whose messages go out with the rest of the team's."""
        events = PublisherEventCallbacks(matched=lambda _: self.look())

        def plain(robot: int, events: PublisherEventCallbacks) -> RobotPublisher:
            publisher: RobotPublisher = node.create_publisher(
                kind.robot_type, topics[robot], NEWEST, event_callbacks=events
            )
            return publisher

        self.robots = [(make or plain)(robot, events) for robot in range(len(robots))]
        """The publishers of their own topics."""
        self._apart = {i for i, topic in enumerate(topics) if overridden(node, topic, "publisher")}
        self._alone = [publisher.publish for publisher in self.robots]
        self._topic = f"{NAMESPACE}/{name}"
        self._team = node.create_publisher(
            kind.team_type, self._topic, NEWEST, event_callbacks=events
        )
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(_LOOK_S, self.look, clock=steady)

    def publish(self, messages: Sequence[RobotMessage]) -> None:
        """The messages of some robots, of which each has one."""
        together = [message for message in messages if message[0] in self.together]
        if together:
            self._team.publish(self._codec.join(together))
        if len(together) < len(messages):
            self.publish_alone([it for it in messages if it[0] not in self.together])

    @property
    def whole(self) -> bool:
        """Whether nobody needs a message of its own."""
        return len(self.together) == len(self.robots)

    def publish_whole(self, data: bytes) -> None:
        """A message of all robots, as it is."""
        self._team.publish(data)

    def publish_alone(self, messages: Sequence[RobotMessage]) -> None:
        """Each on its robot's own topic."""
        for robot, data in messages:
            self._alone[robot](data)

    def look(self) -> None:
        """Asks the graph who listens to what."""
        found = self._node.get_subscriptions_info_by_topic(self._topic)
        heard = self._team.get_subscription_count()
        together: set[int] = set()
        if 0 < len(found) <= heard:
            of_team = {_name(info) for info in found} - {None}
            for robot, topic in enumerate(self._topics):
                of_robot = {*map(_name, self._node.get_subscriptions_info_by_topic(topic))}
                if of_robot and of_robot <= of_team and robot not in self._apart:
                    together.add(robot)
        self.together = frozenset(together)


def _name(info: Any) -> str | None:
    """Of a listener's node; None while it is not known."""
    return None if info.node_name == UNKNOWN else full_name(info)


def subscribe(
    node: Node,
    kind: Kind,
    robots: Sequence[str],
    topics: Sequence[str],
    name: str,
    on_messages: Callable[[list[RobotMessage]], None],
    on_error: Callable[[UserError], None],
    lockstep: bool,
    on_whole: Callable[[bytes, int], bool] | None = None,
) -> list[Any]:
    """Subscribes to robots' ``topics`` and, within NAMESPACE, to the team's topic ``name``.

    Args:
        on_messages: gets each robot's serialized message, with its index among ``robots``.
        on_error: what is wrong with a message of the team.
        lockstep: what is lost is asked for again. So nothing of the team's topic is acknowledged,
            which takes a third of what a message costs.
        on_whole: gets a message of all robots as it is, and where in it the first one's begins;
            returns whether that was enough.

    Returns the subscriptions to robots' topics.
    """
    codec = kind.codec(robots)

    def on_team(data: bytes) -> None:
        try:
            if on_whole is not None:
                at = codec.begin_of_all(data)
                if at is not None and on_whole(data, at):
                    return
            messages = codec.split(data)
        except UserError as error:
            on_error(error)
            return
        on_messages(messages)

    def on_robot(robot: int, data: bytes) -> None:
        on_messages([(robot, data)])

    if not any(overridden(node, topic, "subscription") for topic in topics):
        # Each robot may have a publisher of its own.
        qos = QoSProfile(depth=2 * len(robots))
        if lockstep:
            qos.reliability = ReliabilityPolicy.BEST_EFFORT
        node.create_subscription(kind.team_type, f"{NAMESPACE}/{name}", on_team, qos, raw=True)
    return [
        node.create_subscription(kind.robot_type, topic, partial(on_robot, robot), NEWEST, raw=True)
        for robot, topic in enumerate(topics)
    ]
