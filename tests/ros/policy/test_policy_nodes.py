"""The policy nodes as processes: wire format, answers, refusals."""

from __future__ import annotations

import array
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from crash_coach_interfaces.msg import Action, Observation
from node_process import Child, start, start_file
from policy_team import ALL, OBS, ROBOTS, SPEC, make_agent, sense
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from shared_memory import kill_group

from crash_coach_bringup.ros.client import GraphClient, graph_client
from crash_coach_bringup.ros.graph import Node, node_process
from crash_coach_common.contract import UserError
from policy_pkg.agent import Answer, Sensed
from policy_pkg.checkpoint import PolicyBundle, load_policy
from policy_pkg.ros.convert import bytes_from_answer, sensed_from_bytes
from policy_pkg.untrained import write_untrained


@pytest.fixture(scope="module")
def bundle(checkpoint: Path) -> PolicyBundle:
    return load_policy(checkpoint)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("team") / "step_0"
    write_untrained(folder, SPEC, seed=1)
    return folder


@pytest.mark.parametrize("frame_id", ["", "m", "ma", "map", "base"])
@pytest.mark.parametrize("sizes", [(0, 0), (1, 3), (6, 5)])
def test_the_wire_format_is_rclpys(frame_id: str, sizes: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    features = rng.normal(size=sizes[0]).astype(np.float32)
    available = rng.integers(0, 2, sizes[1], dtype=np.uint8)
    message = Observation(episode=2**32 - 1, step=7, last_action=-1)
    message.header.stamp.sec, message.header.stamp.nanosec = -5, 999_999_999
    message.header.frame_id = frame_id
    message.features = array.array("f", features.tolist())
    message.available_actions = array.array("B", available.tolist())
    data = serialize_message(message)
    sensed = sensed_from_bytes(data)
    assert (sensed.episode, sensed.step, sensed.last_action) == (2**32 - 1, 7, -1)
    assert np.array_equal(sensed.features, features)
    assert np.array_equal(sensed.available, available)
    answer = bytes_from_answer(Answer(0, sensed.episode, sensed.step, 3, 4, sensed.stamp))
    command = deserialize_message(answer, Action)
    expected = Action(header=message.header, episode=2**32 - 1, step=7, action=3, worst_action=4)
    assert command == expected
    with pytest.raises(UserError, match="cut short"):
        sensed_from_bytes(data[: len(data) // 2])
    with pytest.raises(UserError, match="0000 is not little-endian CDR"):
        sensed_from_bytes(b"\0\0" + data[2:])


# --- as processes ---------------------------------------------------------------------------


@contextmanager
def killed_at_the_end(child: Child) -> Iterator[Child]:
    try:
        yield child
    finally:
        kill_group(child)
        child.communicate(timeout=10)


def running(node: Node, env: dict[str, str], merged: bool = True) -> AbstractContextManager[Child]:
    child = start(node.executable, node.package, node.arguments(), env, merged)
    return killed_at_the_end(child)


class Bench:
    """Plays the sim's part for some robots."""

    def __init__(self, client: GraphClient, robots: tuple[str, ...]) -> None:
        self.client = client
        self.commands: list[tuple[str, Action]] = []
        qos = QoSProfile(depth=1)
        self.publishers = {
            name: client.node.create_publisher(Observation, f"/{name}/observation", qos)
            for name in robots
        }
        self.subscriptions = [
            client.node.create_subscription(
                Action,
                f"/{name}/command_raw",
                partial(self.on_command, name),
                qos,
            )
            for name in robots
        ]
        client.until(self.matched, 15, "the policy's topics")

    def on_command(self, robot: str, message: Action) -> None:
        self.commands.append((robot, message))

    def matched(self) -> bool:
        return all(p.get_subscription_count() == 1 for p in self.publishers.values()) and all(
            s.get_publisher_count() == 1 for s in self.subscriptions
        )

    def publish(self, robot: str, sensed: Sensed[str], seconds: int = 0) -> None:
        message = Observation(
            episode=sensed.episode,
            step=sensed.step,
            last_action=sensed.last_action,
            features=array.array("f", sensed.features.tolist()),
            available_actions=array.array("B", sensed.available.tolist()),
        )
        message.header.stamp.sec = seconds
        message.header.frame_id = robot
        self.publishers[robot].publish(message)

    def answers(self, count: int) -> list[tuple[str, Action]]:
        self.client.until(lambda: len(self.commands) >= count, 60, f"{count} commands")
        taken, self.commands = self.commands, []
        return taken


def test_a_policy_process_answers_without_torch_or_sim(
    checkpoint: Path, bundle: PolicyBundle, ros_env: dict[str, str]
) -> None:
    rng = np.random.default_rng(11)
    reference = make_agent(bundle, ("robot_2",))
    parameters = {"checkpoint": str(checkpoint), "robot": "robot_2"}
    node = Node("policy_robot_2", "policy_pkg", "policy", parameters)
    started = time.monotonic()
    with (
        killed_at_the_end(start_file(node_process(node).argv, ros_env)) as child,
        graph_client("bench") as client,
    ):
        bench = Bench(client, ("robot_2",))
        print(f"policy node answers after {time.monotonic() - started:.2f} s")
        for step in range(5):
            sensed = sense(rng, step)
            expected = reference.receive(0, sensed)[0]
            for _ in range(2):
                bench.publish("robot_2", sensed, seconds=100 + step)
                ((_, command),) = bench.answers(1)
                assert (command.episode, command.step) == (0, step)
                assert command.action == expected.action
                assert command.header.stamp.sec == 100 + step
                assert command.header.frame_id == "robot_2"
                assert command.fault == Action.FAULT_NONE
        loaded = Path(f"/proc/{child.pid}/maps").read_text()
        assert "numpy" in loaded
        for foreign in ("torch", "pymunk", "numba"):
            assert foreign not in loaded
        child.terminate()
        assert child.wait(10) == 0


def test_a_team_process_answers_every_robot(
    checkpoint: Path, bundle: PolicyBundle, ros_env: dict[str, str]
) -> None:
    rng = np.random.default_rng(12)
    reference = make_agent(bundle)
    with (
        running(Node("team", "policy_pkg", "team", {"checkpoint": str(checkpoint)}), ros_env),
        graph_client("bench") as client,
    ):
        bench = Bench(client, SPEC.robots)
        for step in range(4):
            expected = {}
            for index, name in enumerate(SPEC.robots):
                sensed = sense(rng, step)
                for answer in reference.receive(index, sensed):
                    expected[SPEC.robots[answer.robot]] = answer.action
                bench.publish(name, sensed)
            got = {name: command.action for name, command in bench.answers(ROBOTS)}
            assert got == expected


def test_an_observation_of_another_size_ends_the_policy(
    checkpoint: Path, ros_env: dict[str, str]
) -> None:
    parameters = {"checkpoint": str(checkpoint), "robot": "robot_1"}
    node = Node("policy_robot_1", "policy_pkg", "policy", parameters)
    with running(node, ros_env) as child, graph_client("bench") as client:
        bench = Bench(client, ("robot_1",))
        features = np.zeros(OBS + 2, dtype=np.float32)
        bench.publish("robot_1", Sensed(0, 0, -1, features, ALL, ""))
        said, _ = child.communicate(timeout=10)
        assert child.returncode == 1
        ready, error = said.splitlines()
        assert ready.endswith("[policy_robot_1]: ready: acts for robot_1")
        assert error == "policy: error: observation of robot_1: expected 6 features, got 8"


@pytest.mark.parametrize(
    ("executable", "parameters", "message"),
    [
        ("team", {}, "'checkpoint' of team is missing"),
        (
            "team",
            {"checkpiont": "x"},
            "unknown parameter 'checkpiont' (did you mean 'checkpoint'?) of team; known: ",
        ),
        ("team", {"checkpoint": "/no/where"}, "/no/where: no such file or directory"),
        ("team", {"checkpoint": 3}, "checkpoint"),
        ("team", {"checkpoint": "HERE", "epsilon": 1.5}, "parameter epsilon = 1.5: Input should"),
        ("team", {"live": True, "epsilon": 0.5}, "parameter 'epsilon' of team has no meaning with"),
        ("policy", {"checkpoint": "HERE"}, "'robot' of policy is missing"),
        ("policy", {"checkpoint": "HERE", "robot": "robot_9"}, "robot 'robot_9' is not of"),
    ],
)
def test_bad_parameters_are_one_line_and_exit_code_1(
    checkpoint: Path,
    ros_env: dict[str, str],
    executable: str,
    parameters: dict[str, str | int | float],
    message: str,
) -> None:
    filled = {k: str(checkpoint) if v == "HERE" else v for k, v in parameters.items()}
    node = Node(executable, "policy_pkg", executable, filled)
    with running(node, ros_env, merged=False) as child:
        _, said = child.communicate(timeout=100)
    assert child.returncode == 1
    assert said.startswith(f"{executable}: error: ")
    assert message in said
    assert len(said.splitlines()) == 1
