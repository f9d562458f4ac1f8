"""Two of what there should be one of: named in the error and on /diagnostics."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from coach_graph import operator, process
from coach_operator import WAIT_S
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Twist

from crash_coach_bringup.ros.client import GraphClient, graph_client
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

ROBOTS = ("robot_1", "robot_2")
TWISTS = {"robots": ROBOTS, "command_type": "geometry_msgs/msg/Twist"}


class Looker:
    """Hears /diagnostics."""

    def __init__(self, client: GraphClient) -> None:
        self.client = client
        self.said: dict[str, DiagnosticStatus] = {}
        client.node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, 100)

    def _hear(self, message: DiagnosticArray) -> None:
        self.said |= {status.name: status for status in message.status}

    def until(self, name: str, words: str) -> DiagnosticStatus:
        def told() -> bool:
            return name in self.said and words in self.said[name].message

        self.client.until(told, 2 * WAIT_S, f"{name}: {words}; said: {self.said.get(name)}")
        return self.said[name]


@pytest.fixture
def looker(ros_env: dict[str, str]) -> Iterator[Looker]:
    with graph_client("looker", int(ros_env["ROS_DOMAIN_ID"])) as client:
        yield Looker(client)


def test_a_coach_that_another_overrules_names_it(ros_env: dict[str, str], looker: Looker) -> None:
    own = {"robots": ROBOTS, "follow_sim": False}
    with ExitStack() as stack:
        stack.enter_context(process(ros_env, "gate", **TWISTS))
        stack.enter_context(process(ros_env, "coach", **own))
        setter = stack.enter_context(operator(ros_env))
        assert not setter.set(victims=["robot_1"], apply_at="next_step")  # it rules alone
        stack.enter_context(process(ros_env, "coach", rules=("__node:=coach_b",), **own))
        names = "2 nodes publish on /coach/plan: /coach, /coach_b"
        assert looker.until("gate: robot_1", names).level != DiagnosticStatus.OK
        answer, number, end = "", 0, time.monotonic() + WAIT_S
        while not answer and time.monotonic() < end:  # until the gate has a plan of the other
            number += 1
            answer = setter.set(victims=[ROBOTS[number % 2]])
        assert answer == f"no gate armed the plan within 5 s; {names}"


def test_two_coaches_of_one_name_are_two(ros_env: dict[str, str], looker: Looker) -> None:
    own = {"robots": ROBOTS, "follow_sim": False}
    with ExitStack() as stack:
        stack.enter_context(process(ros_env, "coach", **own))
        stack.enter_context(process(ros_env, "coach", **own))
        stack.enter_context(process(ros_env, "gate", **TWISTS))
        expected = "2 nodes publish on /coach/plan: /coach, /coach"
        looker.until("gate: robot_2", expected)


def test_without_a_gate_the_error_names_the_other_coach(
    ros_env: dict[str, str], looker: Looker
) -> None:
    own = {"robots": ROBOTS, "follow_sim": False}
    with ExitStack() as stack:
        stack.enter_context(process(ros_env, "coach", **own))
        stack.enter_context(process(ros_env, "coach", rules=("__node:=coach_b",), **own))
        looker.client.greet("/coach_b", WAIT_S, "the second coach")
        setter = stack.enter_context(operator(ros_env))
        answer = setter.set(enabled=True, victims=["robot_1"], apply_at="next_step")
        names = "2 nodes publish on /coach/plan: /coach, /coach_b"
        assert answer == f"no gate armed the plan within 5 s; {names}"


def test_a_second_gate_and_a_second_controller_are_named(
    ros_env: dict[str, str], looker: Looker
) -> None:
    with ExitStack() as stack:
        stack.enter_context(process(ros_env, "gate", **TWISTS))
        stack.enter_context(process(ros_env, "gate", rules=("__node:=gate_b",), **TWISTS))
        looker.until("gate: robot_1", "somebody else publishes on its command topic: /gate")
        looker.client.node.create_publisher(Twist, "/robot_1/cmd_vel_raw", 10)
        other = stack.enter_context(graph_client("joystick", int(ros_env["ROS_DOMAIN_ID"])))
        other.node.create_publisher(Twist, "/robot_1/cmd_vel_raw", 10)
        names = "2 nodes publish on /robot_1/cmd_vel_raw: /joystick, /looker"
        looker.until("gate: robot_1", names)
        assert names not in looker.until("gate: robot_2", "lost").message


def test_a_second_sim_and_a_second_policy_are_named(
    ros_env: dict[str, str], looker: Looker, tmp_path: Path
) -> None:
    """The sims' lock is a machine's: with another folder for it this is another machine."""
    checkpoint = tmp_path / "step_0"
    write_untrained(checkpoint, make_env("buttons", 1).spec, seed=1)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    other = {**os.environ, **ros_env, "TMPDIR": str(elsewhere)}
    shared = {"scenario": "buttons", "mode": "realtime"}
    policy = {"robot": "robot_1", "checkpoint": str(checkpoint)}
    with ExitStack() as stack:
        stack.enter_context(process(ros_env, "gate", robots=ROBOTS, lockstep=False))
        for name in ("one", "two"):
            rules = (f"__node:=policy_{name}",)
            stack.enter_context(process(ros_env, "policy", "policy_pkg", rules=rules, **policy))
        stack.enter_context(process(ros_env, "sim", "sim_pkg", **shared))
        stack.enter_context(process(other, "sim", "sim_pkg", rules=("__node:=sim_b",), **shared))
        looker.until("sim: robot_1", "2 nodes publish on /sim/episode: /sim, /sim_b")
        names = "2 nodes publish on /robot_1/command_raw: /policy_one, /policy_two"
        looker.until("gate: robot_1", names)
