"""The agent's memory, and the policy nodes as processes: answers, duplicates, refusals."""

from __future__ import annotations

import array
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from crash_coach_interfaces.msg import Action, Observation
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message

from crash_coach_bringup.ros.client import GraphClient, graph_client
from crash_coach_bringup.ros.graph import Node, node_process
from policy_pkg.act import greedy
from policy_pkg.agent import Agent, Answer, ObservationError, Sensed
from policy_pkg.checkpoint import PolicyBundle, load_policy
from policy_pkg.ros.convert import bytes_from_answer, sensed_from_bytes
from policy_pkg.untrained import write_untrained
from sim_pkg.contract import EnvSpec, UserError

OBS, ACTIONS, ROBOTS = 6, 5, 3
SPEC = EnvSpec(
    scenario="nowhere",
    robots=tuple(f"robot_{i + 1}" for i in range(ROBOTS)),
    action_names=("up", "down", "left", "right", "stay"),
    stay_actions=(4,),
    obs_size=OBS,
    state_size=1,
    episode_limit=20,
    dt_s=0.5,
    bounds=(-1.0, 1.0),
)
ALL = np.ones(ACTIONS, dtype=np.uint8)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("team") / "step_0"
    write_untrained(folder, SPEC, seed=1)
    return folder


@pytest.fixture(scope="module")
def bundle(checkpoint: Path) -> PolicyBundle:
    return load_policy(checkpoint)


def make_agent(bundle: PolicyBundle, robots: tuple[str, ...] = SPEC.robots) -> Agent[str]:
    return Agent(bundle.policy, bundle.robots, robots, OBS, ACTIONS, greedy)


def sense(rng: np.random.Generator, step: int, episode: int = 0, last: int = -1) -> Sensed[str]:
    features = rng.uniform(-1, 1, OBS).astype(np.float32)
    available = (rng.random(ACTIONS) < 0.6).astype(np.uint8)
    available[4] = 1
    return Sensed(episode, step, last, features, available, f"{episode}/{step}")


def actions(answers: list[Answer[str]]) -> list[int]:
    return [answer.action for answer in answers]


def test_alone_in_a_team_and_by_the_formula_the_actions_are_the_same(bundle: PolicyBundle) -> None:
    rng = np.random.default_rng(5)
    team = make_agent(bundle)
    alone = [make_agent(bundle, (name,)) for name in SPEC.robots]
    seen = set()
    for episode in range(3):
        hidden = bundle.policy.initial_hidden(ROBOTS)
        last = [-1] * ROBOTS
        for step in range(12):
            sensed = [sense(rng, step, episode, last[i]) for i in range(ROBOTS)]
            q, hidden = bundle.policy.forward(
                np.stack([s.features for s in sensed]),
                np.array(last, dtype=np.int32),
                np.arange(ROBOTS, dtype=np.int32),
                hidden,
            )
            expected = greedy(q, np.stack([s.available for s in sensed]).astype(bool)).tolist()
            together = [a for i in (2, 0, 1) for a in team.receive(i, sensed[i])]
            assert actions(together) == expected
            assert [a.robot for a in together] == [0, 1, 2]
            assert [a.stamp for a in together] == [f"{episode}/{step}"] * ROBOTS
            assert [actions(alone[i].receive(0, sensed[i]))[0] for i in range(ROBOTS)] == expected
            last = expected
            seen.update(expected)
    assert len(seen) > 2
    assert team.gaps == 0


def test_a_duplicate_gets_the_old_answer_and_leaves_the_memory_alone(bundle: PolicyBundle) -> None:
    rng = np.random.default_rng(6)
    steps = [sense(rng, step) for step in range(30)]
    plain, disturbed = (make_agent(bundle, ("robot_2",)) for _ in range(2))
    for sensed in steps:
        expected = plain.receive(0, sensed)
        assert disturbed.receive(0, sensed) == expected
        assert disturbed.receive(0, sensed) == expected
    assert len({a.action for s in steps for a in make_agent(bundle).receive(0, s)}) == 0


def test_an_older_observation_than_the_last_answered_is_not_answered(bundle: PolicyBundle) -> None:
    rng = np.random.default_rng(7)
    steps = [sense(rng, step) for step in range(4)]
    agent = make_agent(bundle, ("robot_1",))
    answered = [agent.receive(0, sensed) for sensed in steps]
    assert agent.receive(0, steps[1]) == []
    assert agent.receive(0, steps[3]) == answered[3]


def test_an_incomplete_step_is_answered_when_the_next_one_comes(bundle: PolicyBundle) -> None:
    rng = np.random.default_rng(8)
    first = [sense(rng, 0) for _ in range(ROBOTS)]
    second = [sense(rng, 1, last=0) for _ in range(ROBOTS)]
    agent, whole = make_agent(bundle), make_agent(bundle)
    expected = [a for i in range(ROBOTS) for a in whole.receive(i, first[i])]
    assert agent.receive(0, first[0]) == []
    assert agent.receive(2, first[2]) == []
    assert agent.receive(0, second[0]) == [expected[0], expected[2]]
    assert agent.receive(1, second[1]) == []
    assert len(agent.receive(2, second[2])) == ROBOTS
    assert agent.gaps == 1  # robot_2 was never seen at step 0


def test_a_repeated_observation_of_an_incomplete_step_is_answered_at_once(
    bundle: PolicyBundle,
) -> None:
    rng = np.random.default_rng(9)
    first = [sense(rng, 0) for _ in range(ROBOTS)]
    agent, whole = make_agent(bundle), make_agent(bundle)
    expected = [a for i in range(ROBOTS) for a in whole.receive(i, first[i])]
    assert agent.receive(0, first[0]) == []
    assert agent.receive(0, first[0]) == [expected[0]]
    assert agent.receive(0, first[0]) == [expected[0]]


def test_a_new_episode_forgets_the_old_one(bundle: PolicyBundle) -> None:
    rng = np.random.default_rng(10)
    agent = make_agent(bundle, ("robot_3",))
    start = [sense(rng, step) for step in range(3)]
    before = [actions(agent.receive(0, sensed)) for sensed in start]
    again = [Sensed(1, s.step, s.last_action, s.features, s.available, s.stamp) for s in start]
    assert [actions(agent.receive(0, sensed)) for sensed in again] == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"features": np.zeros(7, np.float32)}, "robot_2: expected 6 features, got 7"),
        ({"available": np.ones(4, np.uint8)}, "robot_2: expected 5 available_actions, got 4"),
        ({"available": np.zeros(5, np.uint8)}, "robot_2: no action is available"),
        ({"last_action": 5}, r"robot_2: last_action 5 is not in \[-1, 4\]"),
        ({"features": np.full(6, np.nan, np.float32)}, "robot_2: the action values are not finite"),
    ],
)
def test_what_the_policy_cannot_use_is_refused(
    bundle: PolicyBundle, change: dict[str, object], message: str
) -> None:
    fields = {
        "episode": 0,
        "step": 0,
        "last_action": -1,
        "features": np.zeros(OBS, np.float32),
        "available": ALL,
        "stamp": "",
    }
    agent = make_agent(bundle, ("robot_2",))
    with pytest.raises(ObservationError, match=message):
        agent.receive(0, Sensed(**{**fields, **change}))  # type: ignore[arg-type]


def test_a_robot_of_another_team_is_refused(bundle: PolicyBundle) -> None:
    with pytest.raises(UserError, match=r"robot_9.*robot_1, robot_2, robot_3"):
        make_agent(bundle, ("robot_9",))


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
    answer = bytes_from_answer(Answer(0, sensed.episode, sensed.step, 3, sensed.stamp))
    command = deserialize_message(answer, Action)
    assert command == Action(header=message.header, episode=2**32 - 1, step=7, action=3)
    with pytest.raises(UserError, match="cut short"):
        sensed_from_bytes(data[: len(data) // 2])
    with pytest.raises(UserError, match="0000 is not little-endian CDR"):
        sensed_from_bytes(b"\0\0" + data[2:])


# --- as processes ---------------------------------------------------------------------------


@contextmanager
def running(node: Node, env: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    child = subprocess.Popen(
        node_process(node).argv,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=env,
    )
    try:
        yield child
    finally:
        if child.poll() is None:
            child.kill()
        child.communicate(timeout=10)


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
        self.client.until(lambda: len(self.commands) >= count, 10, f"{count} commands")
        taken, self.commands = self.commands, []
        return taken


def test_a_policy_process_answers_without_torch_or_sim(
    checkpoint: Path, bundle: PolicyBundle, ros_env: dict[str, str]
) -> None:
    rng = np.random.default_rng(11)
    reference = make_agent(bundle, ("robot_2",))
    parameters = {"checkpoint": str(checkpoint), "robot": "robot_2"}
    started = time.monotonic()
    with (
        running(Node("policy_robot_2", "policy_pkg", "policy", parameters), ros_env) as child,
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
        assert said == "policy: error: observation of robot_1: expected 6 features, got 8\n"


@pytest.mark.parametrize(
    ("executable", "parameters", "message"),
    [
        ("team", {}, "'checkpoint' of team is missing"),
        ("team", {"checkpiont": "x"}, "unknown parameter 'checkpiont' of team; known: checkpoint"),
        ("team", {"checkpoint": "/no/where"}, "/no/where: no such file or directory"),
        ("team", {"checkpoint": 3}, "checkpoint"),
        ("policy", {"checkpoint": "HERE"}, "'robot' of policy is missing"),
        ("policy", {"checkpoint": "HERE", "robot": "robot_9"}, "robot 'robot_9' is not of"),
    ],
)
def test_bad_parameters_are_one_line_and_exit_code_1(
    checkpoint: Path,
    ros_env: dict[str, str],
    executable: str,
    parameters: dict[str, str | int],
    message: str,
) -> None:
    filled = {k: str(checkpoint) if v == "HERE" else v for k, v in parameters.items()}
    node = Node(executable, "policy_pkg", executable, filled)
    done = subprocess.run(
        node_process(node).argv,
        capture_output=True,
        text=True,
        env=ros_env,
        timeout=20,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith(f"{executable}: error: ")
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
