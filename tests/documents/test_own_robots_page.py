"""docs/ros.md, "Robots of your own": its commands are executed, its table held to the gate."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path

import pytest
from coach_graph import operator, process
from coach_operator import WAIT_S
from crash_coach_interfaces.msg import FaultEvent
from kept_running import kept_running
from rclpy.parameter_client import AsyncParameterClient

from crash_coach_bringup.ros.client import graph_client

ROOT = Path(__file__).resolve().parents[2]
SHELL_S = 40.0  # a shell that sources env.sh and loads the command line, on a busy machine
# Of nodes in general, and what every gate has in common.
NOT_IN_THE_TABLE = {"robots", "use_sim_time", "start_type_description_service"}


def section() -> str:
    text = (ROOT / "docs" / "ros.md").read_text()
    found = re.search(r"^## Robots of your own\n(.*?)^## ", text, flags=re.DOTALL | re.MULTILINE)
    assert found is not None
    return found[1]


def commands(verb: str) -> list[str]:
    return [line for block in blocks() for line in block if line.startswith(f"ros2 {verb} ")]


def blocks() -> list[list[str]]:
    found = re.findall(r"```bash\n(.*?)```", section(), flags=re.DOTALL)
    return [block.strip().splitlines() for block in found]


def running(env: dict[str, str], command: str) -> AbstractContextManager[None]:
    return kept_running(["bash", "-c", f"exec {command}"], env, ROOT)


@pytest.mark.parametrize("start", ["run", "launch"])
def test_the_commands_of_the_page_inject_and_clear(ros_env: dict[str, str], start: str) -> None:
    env = ros_env
    if "ROS_DISTRO" not in env:
        env = {**env, "PATH": f"{ROOT / 'tests' / 'documents'}:{env['PATH']}"}
    events: list[FaultEvent] = []
    with ExitStack() as stack:
        for command in commands(start):
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


class Shell:
    """A shell in which a reader types commands, in a checkout of links."""

    def __init__(self, folder: Path, env: dict[str, str], commands: list[str], log: Path) -> None:
        self._log = log
        with open(log, "w") as out:
            script = "\n".join(["set -eo pipefail", *commands])
            self.child = subprocess.Popen(
                ["bash", "-c", script],
                cwd=folder,
                env=env,
                stdout=out,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def said(self) -> list[str]:
        return self._log.read_text().splitlines()

    def until(self, line: str, count: int = 1) -> None:
        end = time.monotonic() + SHELL_S
        while self.said().count(line) < count:
            assert time.monotonic() < end, f"not {count} times {line!r}: {self.said()}"
            assert self.child.poll() is None, f"it ended: {self.said()}"
            time.sleep(0.05)

    def close(self) -> None:
        """As Ctrl-C does."""
        try:
            if self.child.poll() is None:
                os.killpg(self.child.pid, signal.SIGINT)
            self.child.wait(timeout=WAIT_S)
        finally:
            if self.child.poll() is None:
                os.killpg(self.child.pid, signal.SIGKILL)
                self.child.wait(timeout=WAIT_S)


def test_a_reader_without_a_distribution_types_the_page(
    ros_env: dict[str, str], tmp_path: Path
) -> None:
    """In its order, each block in a shell of its own, on a fresh graph."""
    folder = tmp_path / "checkout"
    folder.mkdir()
    for entry in ROOT.iterdir():
        if entry.name not in ("runs", ".git"):
            (folder / entry.name).symlink_to(entry)
    robots, gate, inject, *_ = blocks()
    with ExitStack() as stack:
        rovers = Shell(folder, ros_env, robots, tmp_path / "rovers.txt")
        stack.callback(rovers.close)
        rovers.until("rover_2 stands")
        assert rovers.said() == ["rover_1 stands", "rover_2 stands"]
        relaying = Shell(folder, ros_env, gate, tmp_path / "gate.txt")
        stack.callback(relaying.close)
        rovers.until("rover_1 drives at 0.2 m/s")
        rovers.until("rover_2 drives at 0.2 m/s")
        relaying.until("gate: ready: crash-coach inject --victims rover_1 --mode mute")

        env_sh, mute, scale, clear = inject
        assert typed(folder, ros_env, [env_sh, mute]) == "rover_1: mute from the next step on"
        rovers.until("rover_1 stands", 2)
        relaying.until("rover_1: muted by plan (mute)")
        typed(folder, ros_env, [env_sh, scale])
        rovers.until("rover_1 drives at 0.2 m/s", 2)
        rovers.until("rover_2 drives at 0.1 m/s")
        typed(folder, ros_env, [env_sh, clear])
        rovers.until("rover_2 drives at 0.2 m/s", 2)
        relaying.close()
        assert relaying.child.returncode == 130
        last = f"gate: stopped: no process is left on domain {ros_env['ROS_DOMAIN_ID']}"
        assert relaying.said()[-1] == last
        rovers.until("rover_1 stands", 3)


def typed(folder: Path, env: dict[str, str], commands: list[str]) -> str:
    done = subprocess.run(
        ["bash", "-c", "\n".join(["set -eo pipefail", *commands])],
        cwd=folder,
        env=env,
        capture_output=True,
        text=True,
        timeout=SHELL_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize(
    ("robots", "reason"), [("2nd", "robot name '2nd'"), ("a a", "robots names 'a' more than once")]
)
def test_names_that_are_none_are_refused_before_anything_starts(
    ros_env: dict[str, str], tmp_path: Path, robots: str, reason: str
) -> None:
    logs = tmp_path / "logs"
    done = subprocess.run(
        ["crash-coach", "gate", "--robots", *robots.split(), "--logs", str(logs)],
        env=ros_env,
        capture_output=True,
        text=True,
        timeout=WAIT_S,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith(f"crash-coach: error: {reason}")
    assert not logs.exists()


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
