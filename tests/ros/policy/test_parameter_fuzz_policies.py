"""Random calls to every parameter of the nodes of policy_pkg, all of which are fixed at start: each
is refused with a reason, and the node lives and does its work."""

from __future__ import annotations

import array
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import rclpy
from crash_coach_interfaces.msg import Action, Observation
from node_process import Child, start
from parameter_fuzzer import Fuzzer
from policy_team import ALL, OBS, SPEC
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node as RclNode
from rclpy.qos import QoSProfile
from shared_memory import kill_group

from crash_coach_bringup.ros.graph import Node
from policy_pkg.untrained import write_untrained

SIZES = [40, pytest.param(5000, marks=pytest.mark.soak)]
WORDS = (*SPEC.robots, "command", "observation_seen", "mute", "lockstep", "")


class Fuzzed:
    """One node in a process of its own, and another one that calls it."""

    def __init__(self, process: Child, node: RclNode) -> None:
        self.process = process
        self.node = node
        self.executor = SingleThreadedExecutor(context=node.context)
        self.executor.add_node(node)

    def alive(self) -> None:
        if self.process.poll() is not None:
            raise AssertionError(f"the node ended: {self.process.communicate(timeout=10)[0]}")

    def fuzz(self, target: str, seed: int, calls: int) -> None:
        fuzzer = Fuzzer(self.node, self.executor, target, WORDS, self.alive, seed)
        before = {name: value for name, value in fuzzer.values().items() if name != "use_sim_time"}
        for _ in range(calls):
            after = fuzzer.once()
        assert before == {name: after[name] for name in before}
        assert fuzzer.refused > calls // 2

    def end(self) -> str:
        self.process.send_signal(signal.SIGINT)
        said, _ = self.process.communicate(timeout=100)
        assert self.process.returncode == 0, said
        return said


@contextmanager
def fuzzed(env: dict[str, str], executable: str, **parameters: Any) -> Iterator[Fuzzed]:
    context = Context()
    rclpy.init(context=context)
    started = Node(executable, "policy_pkg", executable, parameters)
    process = start(executable, "policy_pkg", started.arguments(), env, merged=True)
    node = RclNode("fuzzer", context=context)
    one = Fuzzed(process, node)
    try:
        yield one
    finally:
        kill_group(process)
        process.communicate(timeout=10)
        one.executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.parametrize("calls", SIZES)
@pytest.mark.parametrize("executable", ["policy", "team"])
def test_policies(ros_env: dict[str, str], tmp_path: Path, executable: str, calls: int) -> None:
    write_untrained(tmp_path / "step_0", SPEC, seed=1)
    own = {"robot": "robot_1"} if executable == "policy" else {}
    robots = ("robot_1",) if executable == "policy" else SPEC.robots
    checkpoint = str(tmp_path / "step_0")
    with fuzzed(ros_env, executable, checkpoint=checkpoint, **own) as one:
        one.fuzz(f"/{executable}", 4, calls)
        commands: list[Action] = []
        qos = QoSProfile(depth=1)
        for name in robots:
            one.node.create_subscription(Action, f"/{name}/command_raw", commands.append, qos)
        publishers = [
            one.node.create_publisher(Observation, f"/{name}/observation", qos) for name in robots
        ]
        observation = Observation(episode=3, last_action=-1)
        observation.features = array.array("f", [0.0] * OBS)
        observation.available_actions = array.array("B", ALL.tolist())
        for _ in range(100):  # the first may come before the node knows this one
            for publisher in publishers:
                publisher.publish(observation)
            one.executor.spin_once(timeout_sec=0.1)
            if commands:
                break
        assert commands[0].episode == 3
        one.end()


@pytest.mark.parametrize("calls", SIZES)
def test_recorder(ros_env: dict[str, str], tmp_path: Path, calls: int) -> None:
    with fuzzed(ros_env, "recorder", out=str(tmp_path / "bag"), robots=list(SPEC.robots)) as one:
        one.fuzz("/recorder", 5, calls)
        assert "lost: none" in one.end()
