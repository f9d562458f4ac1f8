"""A team's messages in one, and a robot's own where somebody else listens: each heard once."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest
import rclpy
from crash_coach_interfaces.msg import Action, TeamAction
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message

from crash_coach_common.contract import UserError
from crash_coach_common.ros.team_topics import COMMANDS, TeamPublisher, subscribe
from crash_coach_common.team_cdr import RobotMessage

ROBOTS = ("a", "b", "c")
TOPICS = tuple(f"{robot}/command" for robot in ROBOTS)


class Graph:
    """A publisher ``out``, and what a listener of ``hear`` got: (robot, step) in order."""

    def __init__(self) -> None:
        self.context = Context()
        rclpy.init(context=self.context)
        self.executor = EventsExecutor(context=self.context)
        self.nodes: list[Node] = []
        self.out = TeamPublisher(self.node("out"), COMMANDS, ROBOTS, TOPICS, "command")
        self.heard: list[tuple[int, int]] = []
        self.teams: list[TeamAction] = []
        self.errors: list[UserError] = []

    def node(self, name: str, *rules: str) -> Node:
        words = [word for rule in rules for word in ("-r", rule)]
        node = rclpy.create_node(name, context=self.context, cli_args=["--ros-args", *words])
        self.executor.add_node(node)
        self.nodes.append(node)
        return node

    def hear(self, *rules: str, lockstep: bool = False) -> None:
        node = self.node("hear", *rules)
        found = self.on_messages, self.errors.append
        subscribe(node, COMMANDS, ROBOTS, TOPICS, "command", *found, lockstep)

    def on_messages(self, messages: list[RobotMessage]) -> None:
        self.heard += [(robot, deserialize_message(data, Action).step) for robot, data in messages]

    def send(self, step: int) -> list[tuple[int, int]]:
        """What was heard of a step of all robots, in their order."""
        self.heard.clear()
        data = bytes(serialize_message(Action(step=step)))
        self.out.publish([(robot, data) for robot in range(len(ROBOTS))])
        self.spin(0.1)
        return sorted(self.heard)

    def until(self, done: Callable[[], bool]) -> None:
        end = time.monotonic() + 10
        while not done():
            assert time.monotonic() < end
            self.executor.spin_once(timeout_sec=0.02)

    def spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.01)

    def close(self) -> None:
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def graph(ros_env: dict[str, str]) -> Iterator[Graph]:
    made = Graph()
    try:
        yield made
    finally:
        made.close()


def every(step: int) -> list[tuple[int, int]]:
    return [(robot, step) for robot in range(len(ROBOTS))]


@pytest.mark.parametrize("lockstep", [False, True])
def test_who_hears_the_team_needs_nothing_else(graph: Graph, lockstep: bool) -> None:
    assert graph.out.together == frozenset()
    graph.hear(lockstep=lockstep)
    graph.until(lambda: graph.out.whole)
    alone: list[RobotMessage] = []
    graph.out.publish_alone = alone.extend  # type: ignore[method-assign]
    assert graph.send(1) == every(1)
    assert not alone


def test_somebody_elses_robot_goes_out_on_its_own_topic_meanwhile(graph: Graph) -> None:
    graph.hear()
    graph.until(lambda: graph.out.whole)
    echoed: list[int] = []
    echo = graph.node("echo")
    listening = echo.create_subscription(Action, "b/command", lambda m: echoed.append(m.step), 10)
    graph.until(lambda: graph.out.together == {0, 2})
    assert graph.send(1) == every(1)  # each once
    assert graph.send(2) == every(2)
    assert echoed == [1, 2]
    echo.destroy_subscription(listening)
    graph.until(lambda: graph.out.whole)
    assert graph.send(3) == every(3)
    assert echoed == [1, 2]


def test_a_robot_that_is_remapped_away_is_not_told_behind_the_remappings_back(
    graph: Graph,
) -> None:
    graph.hear("b/command:=elsewhere")
    graph.until(lambda: graph.out.together == {0, 2})
    assert graph.send(1) == [(0, 1), (2, 1)]


def test_without_a_listener_of_the_team_all_go_out_alone(graph: Graph) -> None:
    got: list[int] = []
    other = graph.node("other")
    for topic in TOPICS:
        other.create_subscription(Action, topic, lambda m: got.append(m.step), 10)
    graph.spin(0.3)
    graph.send(4)
    graph.until(lambda: got == [4, 4, 4])


def test_what_is_no_message_of_a_team_is_told(graph: Graph) -> None:
    graph.hear()
    publisher = graph.node("bad").create_publisher(TeamAction, "_team/command", 1)
    graph.until(lambda: publisher.get_subscription_count() > 0)
    graph.spin(0.2)
    publisher.publish(TeamAction(robots=["a", "b"], commands=[Action()]))
    graph.until(lambda: len(graph.errors) > 0)
    assert str(graph.errors[0]) == "team's commands: 1 messages for 2 robots"
