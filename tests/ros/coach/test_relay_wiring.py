"""How a gate is put into a foreign system: names, remapping, types that do not fit."""

from __future__ import annotations

from typing import Any

import pytest
from coach_graph import operator, process, run_to_end
from coach_operator import WAIT_S
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Twist, TwistStamped

from crash_coach_bringup.ros.client import GraphClient, graph_client

TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
TWO = {"robots": ("a", "b"), "command_type": TWIST}
ONE = {"robots": ("a",), "command_type": TWIST}


@pytest.mark.parametrize(
    ("parameters", "rules", "message"),
    [
        ({**TWO, "raw_topic": "cmd_vel"}, (), "feed itself: it would listen for a on /a/cmd_vel "),
        (TWO, ("b/cmd_vel_raw:=a/cmd_vel",), "feed itself: it would listen for b on /a/cmd_vel "),
        (
            ONE,
            ("a/cmd_vel:=a/cmd_vel_raw",),
            "feed itself: it would listen for a on /a/cmd_vel_raw",
        ),
        ({"robots": ("a",), "raw_topic": "command"}, (), "feed itself: it would listen for a"),
        (
            {"robots": ("a",), "relay_observations": True},
            ("a/observation:=a/observation_seen",),
            "feed itself: it would listen for a on /a/observation_seen",
        ),
        ({**TWO, "raw_topic": "/cmd_vel_raw"}, (), "raw_topic: a and b would share /cmd_vel_raw"),
        (
            {**TWO, "raw_topic": "cmd vel"},
            (),
            "parameter raw_topic = 'cmd vel': failed to resolve name: topic",
        ),
        ({**TWO, "command_topic": "/"}, (), "parameter command_topic = '/' names no topic"),
        ({**TWO, "robot_namespaces": ("x",)}, (), r"robot_namespaces ['x']: 1 for 2 robots"),
    ],
)
def test_what_cannot_be_wired_ends_the_gate_with_one_line(
    ros_env: dict[str, str], parameters: dict[str, Any], rules: tuple[str, ...], message: str
) -> None:
    code, errors = run_to_end(ros_env, "gate", rules, **parameters)
    assert code == 1
    assert errors.startswith("gate: error: ")
    assert errors.count("\n") == 1
    assert message in errors


class Lane:
    """A publisher of commands before the gate and a listener behind it."""

    def __init__(self, client: GraphClient, raw: str, command: str, type_: type = Twist) -> None:
        self.client = client
        self.got: list[Any] = []
        self.status: DiagnosticStatus | None = None
        self.command = type_()
        self.raw = client.node.create_publisher(type_, raw, 10)
        client.node.create_subscription(type_, command, self.got.append, 10)
        client.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.status = message.status[0]

    def passes(self) -> None:
        def passed() -> bool:
            self.raw.publish(self.command)
            return bool(self.got)

        self.client.until(passed, WAIT_S, "a command behind the gate")

    def says(self, words: str) -> None:
        self.client.until(
            lambda: self.status is not None and words in self.status.message, WAIT_S, words
        )


@pytest.mark.parametrize(
    ("parameters", "rules", "raw", "command"),
    [
        (
            {"raw_topic": "/cmd_vel_raw", "command_topic": "/cmd_vel"},
            (),
            "/cmd_vel_raw",
            "/cmd_vel",
        ),
        ({"robot_namespaces": ("''",)}, (), "/cmd_vel_raw", "/cmd_vel"),
        ({"robot_namespaces": ("/north/a1",)}, (), "/north/a1/cmd_vel_raw", "/north/a1/cmd_vel"),
        ({}, ("a/cmd_vel_raw:=joystick",), "/joystick", "/a/cmd_vel"),
        ({}, ("__ns:=/fleet",), "/fleet/a/cmd_vel_raw", "/fleet/a/cmd_vel"),
    ],
)
def test_names_lead_where_they_say(
    ros_env: dict[str, str],
    parameters: dict[str, Any],
    rules: tuple[str, ...],
    raw: str,
    command: str,
) -> None:
    with (
        process(ros_env, "gate", rules=rules, **ONE, **parameters),
        graph_client("lane", int(ros_env["ROS_DOMAIN_ID"])) as client,
    ):
        Lane(client, raw, command).passes()


def test_who_speaks_another_type_is_named(ros_env: dict[str, str]) -> None:
    with (
        process(ros_env, "gate", **ONE),
        graph_client("controller", int(ros_env["ROS_DOMAIN_ID"])) as client,
    ):
        lane = Lane(client, "/a/cmd_vel_raw", "/a/cmd_vel", TwistStamped)
        lane.says(
            f"/controller publishes {STAMPED} on /a/cmd_vel_raw, but this gate relays {TWIST}"
        )
        lane.says(
            f"/controller listens for {STAMPED} on /a/cmd_vel, but this gate publishes {TWIST}"
        )
        assert lane.status is not None
        assert "nobody" not in lane.status.message
        client.node.destroy_publisher(lane.raw)
        lane.says("nobody publishes on /a/cmd_vel_raw")


def test_auto_takes_the_type_that_is_published(ros_env: dict[str, str]) -> None:
    parameters = {"robots": ("a",), "dt_s": 0.05}
    with (
        process(ros_env, "gate", command_type="auto", **parameters),
        process(ros_env, "coach", follow_sim=False, **parameters),
        operator(ros_env) as setter,
        graph_client("controller", int(ros_env["ROS_DOMAIN_ID"])) as client,
    ):
        refused = setter.set(victims=["a"], crash_mode="scale", **{"scale.linear": 0.0})
        assert "type of the commands is not known yet" in refused
        lane = Lane(client, "/a/cmd_vel_raw", "/a/cmd_vel", TwistStamped)
        lane.command.twist.linear.x = 1.0
        lane.passes()
        assert lane.got[-1] == lane.command
        assert not setter.set(victims=["a"], crash_mode="scale", **{"scale.linear": 0.0})
        lane.got.clear()
        lane.passes()
        client.pause(0.2)
        lane.got.clear()
        lane.passes()
        assert lane.got[-1].twist.linear.x == 0.0


def test_a_rule_for_the_plan_moves_both_its_ends(ros_env: dict[str, str]) -> None:
    rules = ("/coach/plan:=/x/plan",)
    parameters = {"robots": ("a",), "dt_s": 0.05}
    with (
        process(ros_env, "gate", rules=rules, command_type=TWIST, **parameters),
        process(ros_env, "coach", rules=rules, follow_sim=False, **parameters),
        operator(ros_env) as setter,
        graph_client("looker", int(ros_env["ROS_DOMAIN_ID"])) as client,
    ):
        assert not setter.set(victims=["a"], crash_mode="mute")  # the gate has armed it
        node = client.node

        def both() -> bool:
            return node.count_publishers("/x/plan") == node.count_subscribers("/x/plan") == 1

        client.until(both, WAIT_S, "both ends of /x/plan")
        assert node.count_publishers("/coach/plan") == node.count_subscribers("/coach/plan") == 0


def test_another_name_for_the_coach_leaves_one_visible_node(ros_env: dict[str, str]) -> None:
    with (
        process(ros_env, "coach", rules=("__node:=boss", "__ns:=/hq"), robots=("a",)),
        graph_client("looker", int(ros_env["ROS_DOMAIN_ID"])) as client,
    ):
        client.greet("/hq/boss", WAIT_S, "the coach")

        def names() -> set[tuple[str, str]]:
            return set(client.node.get_node_names_and_namespaces()) - {("looker", "/")}

        both = {("boss", "/hq"), ("_coach_link", "/hq")}
        client.until(lambda: names() >= both, WAIT_S, "both nodes")  # names come after services
        assert names() == both
