"""``qos_overrides.*`` count on the topics of every node of ours, as on those of any ROS node."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import rclpy
from coach_graph import process
from crash_coach_interfaces.msg import Action, EpisodeState
from geometry_msgs.msg import Twist
from rclpy.context import Context
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from crash_coach_bringup.ros.client import GraphClient, graph_client
from crash_coach_bringup.ros.graph import UpOptions, check_team, graph_environment, graph_processes
from crash_coach_bringup.ros.supervisor import Supervisor
from crash_coach_common.contract import UserError
from crash_coach_common.ros.qos import NEWEST
from crash_coach_common.ros.qos_node import QosNode
from crash_coach_common.ros.team_topics import COMMANDS, TeamPublisher, subscribe

WAIT_S = 60.0
FILE = """
/**:
  ros__parameters:
    qos_overrides:
      /robot_1/observation: {publisher: {durability: transient_local}}
      /robot_1/command_raw:
        publisher: {reliability: best_effort}
        subscription: {reliability: best_effort, depth: 7}
      /robot_1/command: {publisher: {durability: transient_local}}
      /sim/episode: {publisher: {durability: volatile}}
      /coach/plan: {subscription: {durability: volatile}}
      /coach/evnts: {publisher: {depth: 3}}
"""


def offers(client: GraphClient, topic: str, node: str) -> list[Any]:
    """The profiles of a node's publishers on a topic; waits for its name, which comes last."""
    return _profiles(client, partial(client.node.get_publishers_info_by_topic, topic), node)


def requests(client: GraphClient, topic: str, node: str) -> list[Any]:
    """The profiles of its subscriptions."""
    return _profiles(client, partial(client.node.get_subscriptions_info_by_topic, topic), node)


def _profiles(client: GraphClient, ends: Callable[[], list[Any]], node: str) -> list[Any]:
    def named() -> bool:
        return any(end.node_name == node for end in ends())

    client.until(named, WAIT_S, f"an end of {node}")
    return [end.qos_profile for end in ends() if end.node_name == node]


def test_in_a_whole_team(ros_env: dict[str, str], tmp_path: Path) -> None:
    """Lock-step goes on, and who has no override keeps to what he had."""
    (tmp_path / "qos.yaml").write_text(FILE)
    options = UpOptions(
        scenario="buttons", checkpoint=Path("scripted:random"), layout="single",
        params_file=tmp_path / "qos.yaml", sim={"pace_hz": 100.0},
    )  # fmt: skip
    domain, seen = int(ros_env["ROS_DOMAIN_ID"]), list[int]()
    processes = graph_processes(options, check_team(options))
    with (
        Supervisor(processes, tmp_path / "logs", graph_environment(domain)) as running,
        graph_client("observer", domain) as client,
    ):
        client.node.create_subscription(
            EpisodeState, "/sim/boundary", lambda state: seen.append(state.episode), 10
        )
        client.until(lambda: bool(seen) and seen[-1] >= 2, WAIT_S, "two episodes")
        lasting, fleeting = DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE
        for topic, node in (("observation", "sim"), ("command", "gate")):
            (one,) = offers(client, f"/robot_1/{topic}", node)
            (other,) = offers(client, f"/robot_2/{topic}", node)
            assert (one.durability, other.durability) == (lasting, fleeting)
        for ends in (offers(client, "/robot_1/command_raw", "team"),
                     requests(client, "/robot_1/command_raw", "gate")):  # fmt: skip
            assert [end.reliability for end in ends] == [ReliabilityPolicy.BEST_EFFORT]
        (raw,) = offers(client, "/robot_2/command_raw", "team")
        assert raw.reliability == ReliabilityPolicy.RELIABLE
        assert [o.durability for o in offers(client, "/sim/episode", "sim")] == [fleeting]
        assert [r.durability for r in requests(client, "/coach/plan", "gate")] == [fleeting]
        (log,) = {running.log_of(name) for name in running.pids()}
    said = log.read_text()
    assert said.count("qos_overrides./coach/evnts.publisher.depth has no effect so far") == 1
    assert said.count("has no effect so far") == 1


def test_a_gate_of_another_type(ros_env: dict[str, str]) -> None:
    """An override counts over what the gate matches by itself."""
    given = {
        "qos_overrides./a/cmd_vel_raw.subscription.reliability": "best_effort",
        "qos_overrides./a/cmd_vel.publisher.durability": "transient_local",
    }
    with (
        process(ros_env, "gate", robots=("a",), command_type="geometry_msgs/msg/Twist", **given),
        graph_client("controller", int(ros_env["ROS_DOMAIN_ID"])) as client,
    ):
        reliable = client.node.create_publisher(Twist, "/a/cmd_vel_raw", 10)
        got: list[Twist] = []
        asked = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        client.node.create_subscription(Twist, "/a/cmd_vel", got.append, asked)

        def passed() -> bool:
            reliable.publish(Twist())
            return bool(got)

        client.until(passed, WAIT_S, "a command behind the gate")
        (request,) = requests(client, "/a/cmd_vel_raw", "gate")
        assert request.reliability == ReliabilityPolicy.BEST_EFFORT


Make = Callable[..., QosNode]


@pytest.fixture
def make(ros_env: dict[str, str]) -> Iterator[Make]:
    """A node that was given overrides."""
    context = Context()
    rclpy.init(context=context)
    nodes: list[QosNode] = []

    def made(*given: str, rules: tuple[str, ...] = ()) -> QosNode:
        words = [word for text in given for word in ("-p", f"qos_overrides.{text}")]
        words += [word for rule in rules for word in ("-r", rule)]
        nodes.append(
            QosNode(f"node_{len(nodes)}", context=context, cli_args=["--ros-args", *words])
        )
        return nodes[-1]

    yield made
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown(context=context)


def test_names_count_as_they_are_resolved_and_profiles_are_left_alone(make: Make) -> None:
    node = make(
        "/north/b/command.publisher.depth:=4", rules=("__ns:=/north", "a/command:=b/command")
    )
    publisher = node.create_publisher(Action, "a/command", NEWEST)
    assert (publisher.qos_profile.depth, NEWEST.depth) == (4, 1)
    name = "qos_overrides./north/b/command.publisher.depth"
    assert node.get_parameter(name).value == 4
    assert [each for each in node._parameters if each.startswith("qos_overrides")] == [name]


def test_an_overridden_topic_of_a_robot_is_used(make: Make) -> None:
    """Not the team's: neither to publish nor to listen."""
    robots, topics = ("a", "b"), ("a/command", "b/command")
    node = make("/a/command.publisher.depth:=4")
    out = TeamPublisher(node, COMMANDS, robots, topics, "command")
    plain, asking = make(), make("/b/command.subscription.depth:=4")
    for listener in (plain, asking):
        subscribe(listener, COMMANDS, robots, topics, "command", print, print, False)
    counts = [node.count_subscribers(topic) for topic in ("/_team/command", "/b/command")]
    assert counts == [1, 2]
    asking.destroy_node()
    end_s = time.monotonic() + WAIT_S
    while not out.together:
        assert time.monotonic() < end_s
        time.sleep(0.02)
        out.look()
    assert out.together == {1}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("/a.publisher.dept:=1", r"'dept' is none of .*did you mean 'depth'"),
        ("/a.publishr.depth:=1", r"'publishr' is none of publisher, subscription.*did you mean"),
        ("depth:=1", r"parameter qos_overrides\.depth: 'qos_overrides' is none of publisher"),
        ("/a.publisher.depth:=many", r"depth = 'many': must be a number from 0 on"),
        ("/a.publisher.deadline:=-1", r"deadline = -1: must be a number from 0 on, nanoseconds"),
        ("/a.publisher.reliability:=best", r"= 'best'; one of: system_default, reliable, best_eff"),
        ("/a.publisher.history:=1", r"history = 1; one of: system_default, keep_last, keep_all"),
        ("/a.subscription.lifespan:=1", r"a subscription has no lifespan"),
        ("/a.publisher.avoid_ros_namespace_conventions:=1", r"= 1: must be true or false"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_named(make: Make, given: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        make(given)
