"""docs/ros.md, "Robots of your own": its commands are executed, its table held to the gate."""

from __future__ import annotations

import os
import re
import signal
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from coach_graph import operator, process
from coach_operator import WAIT_S
from crash_coach_interfaces.msg import FaultEvent
from rclpy.parameter_client import AsyncParameterClient

from crash_coach_bringup.ros.client import graph_client

ROOT = Path(__file__).resolve().parents[3]
# Of nodes in general, and what every gate has in common.
NOT_IN_THE_TABLE = {"robots", "use_sim_time", "start_type_description_service"}


def section() -> str:
    text = (ROOT / "docs" / "ros.md").read_text()
    found = re.search(r"^## Robots of your own\n(.*?)^## ", text, flags=re.DOTALL | re.MULTILINE)
    assert found is not None
    return found[1]


def commands(verb: str) -> list[str]:
    (block,) = re.findall(r"```bash\n(.*?)```", section(), flags=re.DOTALL)
    return [line for line in block.splitlines() if line.startswith(f"ros2 {verb} ")]


@contextmanager
def running(env: dict[str, str], command: str) -> Iterator[None]:
    child = subprocess.Popen(["bash", "-c", f"exec {command}"], env=env, start_new_session=True)
    try:
        yield
        assert child.poll() is None, f"it ended: {command}"
    finally:
        if child.poll() is None:
            os.killpg(child.pid, signal.SIGKILL)
        child.wait(timeout=WAIT_S)


def test_the_commands_of_the_page_inject_and_clear(ros_env: dict[str, str]) -> None:
    env = ros_env
    if "ROS_DISTRO" not in env:
        env = {**env, "PATH": f"{ROOT / 'tests' / 'documents'}:{env['PATH']}"}
    events: list[FaultEvent] = []
    with ExitStack() as stack:
        for command in commands("run"):
            stack.enter_context(running(env, command))
        setter = stack.enter_context(operator(env))
        client = stack.enter_context(graph_client("reader", int(env["ROS_DOMAIN_ID"])))
        client.node.create_subscription(FaultEvent, "/coach/events", events.append, 100)
        client.until(
            lambda: client.node.count_publishers("/coach/events") > 0, WAIT_S, "the gate's events"
        )
        client.pause(0.3)
        for command in commands("param"):
            done = subprocess.run(
                ["bash", "-c", command], env=env, capture_output=True, text=True, timeout=WAIT_S
            )
            assert done.returncode == 0, done.stdout + done.stderr
        assert setter.get("crash_mode", "delay.steps", "victims") == ["delay", 5, ["none"]]
        client.until(
            lambda: any(e.kind == FaultEvent.CLEARED and not e.robot for e in events),
            WAIT_S,
            "the end of the fault",
        )
    active = [(e.robot, e.mode) for e in events if e.kind == FaultEvent.ACTIVE]
    assert active == [("rover_1", "delay")]


def test_the_table_lists_every_parameter_of_the_gate(ros_env: dict[str, str]) -> None:
    listed = {
        name
        for row in re.findall(r"^\|([^|]*)\|[^|]*\|[^|]*\|$", section(), flags=re.MULTILINE)
        for name in re.findall(r"`([a-z_.]+)`", row)
    }
    with (
        process(ros_env, "gate", robots=("a", "b"), command_type="geometry_msgs/msg/Twist"),
        graph_client("reader", int(ros_env["ROS_DOMAIN_ID"])) as client,
    ):
        client.greet("/gate", WAIT_S, "the gate")
        parameters = AsyncParameterClient(client.node, "/gate")
        client.until(parameters.services_are_ready, WAIT_S, "the gate's parameters")
        declared = client.result(parameters.list_parameters([], 0), WAIT_S, "names").result.names
    assert listed == set(declared) - NOT_IN_THE_TABLE
