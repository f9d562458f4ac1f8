"""Gate and coach for a team of one's own, and parameter files for any graph."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from ament_index_python.packages import get_package_share_directory
from node_process import start
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient

from crash_coach_bringup.ros.client import graph_client
from crash_coach_bringup.ros.graph import Node, placed
from crash_coach_bringup.ros.launch_arguments import OWN_ARGUMENTS, own_from
from crash_coach_bringup.ros.own_robots import OwnRobots, own_nodes
from crash_coach_common.contract import UserError

WAIT_S = 30.0
SAMPLE = Path(get_package_share_directory("crash_coach_bringup")) / "config" / "own_robots.yaml"


@contextmanager
def started(nodes: Sequence[Node], env: dict[str, str]) -> Iterator[None]:
    children = [start(node.executable, node.package, node.arguments(), env) for node in nodes]
    try:
        yield
        for child in children:
            assert child.poll() is None, child.communicate(WAIT_S)
    finally:
        for child in children:
            child.kill()
            child.communicate(timeout=WAIT_S)


def values(node: str, *names: str) -> list[Any]:
    """Of a node that runs on the test's domain."""
    with graph_client("reader") as client:
        client.greet(node, WAIT_S, node)
        reader = AsyncParameterClient(client.node, node)
        client.until(reader.services_are_ready, WAIT_S, f"parameters of {node}")
        answer = client.result(reader.get_parameters(list(names)), WAIT_S, "values")
    return [parameter_value_to_python(value) for value in answer.values]


def nodes_of(tmp_path: Path, text: str, **options: Any) -> dict[str, Node]:
    file = tmp_path / "params.yaml"
    file.write_text(text)
    return {node.name: node for node in own_nodes(OwnRobots(params_file=file, **options))}


@pytest.mark.parametrize("namespace", ["", "fleet_a"])
def test_the_sample_file_starts_both(ros_env: dict[str, str], namespace: str) -> None:
    nodes = own_nodes(OwnRobots(params_file=SAMPLE, namespace=namespace))
    space = f"/{namespace}" if namespace else ""
    with started(nodes, ros_env):
        gate = values(f"{space}/gate", "robots", "command_type", "dt_s", "limit.linear_x_m_s")
        assert gate == [["rover_1", "rover_2"], "geometry_msgs/msg/Twist", 0.05, 0.5]
        coach = values(f"{space}/coach", "robots", "dt_s", "follow_sim", "apply_at")
        assert coach == [["rover_1", "rover_2"], 0.05, False, "next_step"]


@pytest.mark.parametrize("key", ["coach", "/coach", "/**", "/*", "/**/coach"])
def test_the_file_wins_over_what_the_graph_is_started_with(
    ros_env: dict[str, str], tmp_path: Path, key: str
) -> None:
    file = tmp_path / "params.yaml"
    file.write_text(f"{key}:\n  ros__parameters: {{lease_s: 3.5, seed: 5}}\n")
    given = {"robots": ["a"], "follow_sim": False, "lease_s": 1.5, "crash_rate": 0.25}
    (node,) = placed([Node("coach", "crash_coach_pkg", "coach", given)], "", file, "info")
    with started([node], ros_env):
        assert values("/coach", "lease_s", "seed", "crash_rate") == [3.5, 5, 0.25]


def test_one_robot_and_what_is_given_beside_the_file(tmp_path: Path) -> None:
    text = "gate:\n  ros__parameters: {dt_s: 0.02, command_type: std_msgs/msg/String}\n"
    nodes = nodes_of(tmp_path, text, robots=("solo",), raw_topic="/raw")
    assert nodes["gate"].parameters == {
        "robots": ["solo"],
        "dt_s": 0.02,
        "command_type": "std_msgs/msg/String",
        "raw_topic": "/raw",
    }
    assert nodes["coach"].parameters == {"robots": ["solo"], "dt_s": 0.02, "follow_sim": False}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("gate: {ros__parameters: {robots: [b]}}", r"robots of /gate is \['b'\], but the graph is"),
        ("/**: {ros__parameters: {follow_sim: true}}", "follow_sim of /coach is True"),
        ("gate: {ros__parameters: {command_type: auto}}", "command_type of /gate is 'auto'"),
        ("gate: {parameters: 1}", "a node's name with ros__parameters is needed"),
        ("gate: {ros__parameters: 7}", "ros__parameters of /gate are no parameters"),
        ("{}", "no ros__parameters in it"),
        ("gate: [", "params.yaml"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(UserError, match=reason):
        nodes_of(tmp_path, text, robots=("a",), command_type="geometry_msgs/msg/Twist")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("/fleet_a/gate: {ros__parameters: {robots: [a]}}", "names no robots of /gate"),
        ("gate: {ros__parameters: {robots: a}}", "robots is 'a'; a list of names is needed"),
        ("gate: {ros__parameters: {robots: [a, a]}}", "robots names 'a' more than once"),
    ],
)
def test_robots_of_the_file_are_checked(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(UserError, match=reason):
        nodes_of(tmp_path, text)


def test_a_file_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"nothing\.yaml: cannot be read"):
        own_nodes(OwnRobots(params_file=tmp_path / "nothing.yaml"))


def test_every_launch_argument_reaches_gate_or_coach() -> None:
    given = {
        "robots": "rover_1, rover_2",
        "command_type": "geometry_msgs/msg/Twist",
        "raw_topic": "raw",
        "command_topic": "out",
        "dt_s": "0.02",
        "namespace": "fleet_a",
        "params_file": "",
        "use_sim_time": "true",
        "log_level": "debug",
        "fault_scenario": "one_mute",
    }
    assert set(given) == {argument.name for argument in OWN_ARGUMENTS}
    gate, coach = own_nodes(own_from(given))
    shared = {"robots": ["rover_1", "rover_2"], "dt_s": 0.02, "use_sim_time": True}
    topics = {"command_type": given["command_type"], "raw_topic": "raw", "command_topic": "out"}
    assert gate.parameters == {**shared, **topics}
    scenario = coach.parameters["fault_scenario"]
    assert coach.parameters == {**shared, "follow_sim": False, "fault_scenario": scenario}
    assert str(scenario).endswith("one_mute.yaml")
    assert (gate.namespace, gate.log_level) == (coach.namespace, coach.log_level)
    assert (gate.namespace, gate.log_level) == ("/fleet_a", "debug")
