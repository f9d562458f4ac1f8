"""The recorder on a real graph: what it recorded is what the same seeds give in this process."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from crash_coach_bringup.ros.graph import (
    Process,
    UpOptions,
    check_team,
    graph_environment,
    graph_processes,
    ros_arguments,
)
from crash_coach_bringup.ros.supervisor import Supervisor
from crash_coach_common.contract import EnvSpec
from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.team import TeamSpec
from policy_pkg.bags.dataset import RecordedEpisode, load_episodes
from policy_pkg.bags.problems import Problem
from policy_pkg.checkpoint import load_policy
from policy_pkg.episode import Episode
from policy_pkg.play.rollout import Rollout
from policy_pkg.ros.recorder_node import PROFILE, PROFILE_VARIABLE
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

SEED = 11
SPLIT_EPISODES = 200
# The sim may begin before it has found the recorder; an episode takes some hundredths of a second.
MISSED = 15
ARRAYS = ("obs", "state", "available", "actions", "reward", "faults")
RANDOM = CoachConfig(strategy="fixed", crash_rate=0.5, crash_mode="random")
MUTE = CoachConfig(strategy="fixed", crash_rate=0.5, crash_mode="mute", start_step=3)
BLIND = CoachConfig(strategy="fixed", crash_rate=0.7, crash_mode="blind", duration_steps=4)


def recorder(out: Path, spec: EnvSpec, episodes: int) -> Process:
    parameters: dict[str, Any] = {
        "out": str(out),
        "robots": list(spec.robots),
        "scenario": spec.scenario,
        "seed": SEED,
        "dt_s": spec.dt_s,
        "episode_limit": spec.episode_limit,
        "episodes": episodes,
        "split_episodes": SPLIT_EPISODES,
    }
    arguments = ros_arguments([], "", parameters)
    return Process("recorder", (sys.executable, "-m", "policy_pkg.ros.recorder_node", *arguments))


def record(
    folder: Path, domain: int, crash: CoachConfig, episodes: int, epsilon: float = 0.0
) -> Path:
    """Plays episodes 0.. over ROS; returns the recording's folder."""
    spec = make_env("buttons", 1).spec
    checkpoint = folder / "team" / "step_0"
    write_untrained(checkpoint, spec, seed=4)
    options = UpOptions(
        "buttons", checkpoint, layout="single", seed=SEED, coach=crash, domain=domain,
        epsilon=epsilon, sim={"match_timeout_s": 60.0},
    )  # fmt: skip
    processes = [
        recorder(folder / "bag", spec, episodes),
        *graph_processes(options, check_team(options)),
    ]
    environment = {**graph_environment(domain), PROFILE_VARIABLE: str(PROFILE)}
    with Supervisor(processes, folder / "logs", environment) as graph:
        ended = graph.wait(90.0)
    assert [(one.name, one.exit_code) for one in ended] == [("recorder", 0)], ended
    assert "lost: none" in ended[0].tail
    return folder / "bag"


class Keyed(np.random.Generator):
    """Draws of one step, for all robots at once; the keys of policy nodes, said again."""

    def __init__(self) -> None:
        super().__init__(np.random.PCG64(0))
        self.episode = self.step = 0

    def random(self, size: tuple[int, int, int]) -> npt.NDArray[np.float64]:  # type: ignore[override]
        key = np.array([SEED ^ 0xE8910, self.episode], dtype=np.uint64)
        bits = np.random.Philox(key=key, counter=[0, self.step, 0, 0])
        return np.random.Generator(bits).random(size)


def rolled_out(
    checkpoint: Path, crash: CoachConfig, episodes: int, epsilon: float
) -> dict[int, tuple[Episode, bool]]:
    """The same episodes in this process, by number; their last situation as a bag has it."""
    env = make_env("buttons", 1)
    coach = Coach(crash, TeamSpec.of(env.spec), SEED)
    policy = load_policy(checkpoint).policy
    draws = Keyed()
    rollout = Rollout(env, policy, coach.plan, SEED, draws)
    out: dict[int, tuple[Episode, bool]] = {}
    while len(out) < episodes:
        ended = rollout.step(epsilon)
        draws.step += 1
        for finished in ended:
            draws.episode, draws.step = draws.episode + 1, 0
            arrays = {name: getattr(finished.episode, name).copy() for name in ARRAYS}
            if finished.episode.terminated:
                arrays["obs"][-1] = 0
                arrays["available"][-1] = False
            out[len(out)] = (replace(finished.episode, **arrays), finished.success)
    return out


def compare(expected: dict[int, tuple[Episode, bool]], got: RecordedEpisode) -> None:
    episode, success = expected[got.number]
    assert (got.seed, got.success) == (SEED, success)
    for name in ARRAYS:
        one, other = getattr(episode, name), getattr(got.episode, name)
        assert (one.dtype, one.shape) == (other.dtype, other.shape), name
        assert one.tobytes() == other.tobytes(), f"episode {got.number}: {name}"
    intended = got.episode.faults == 0
    assert np.array_equal(got.intents[intended], got.episode.actions[intended])
    assert (got.intents >= 0).all()


def check_recording(
    folder: Path, domain: int, crash: CoachConfig, episodes: int, epsilon: float = 0.0
) -> None:
    played = MISSED + episodes
    bag = record(folder, domain, crash, played, epsilon)
    expected = rolled_out(folder / "team" / "step_0", crash, played, epsilon)
    check_bag(bag, expected)
    check_bag(shuffled(bag, folder / "shuffled"), expected)


def check_bag(bag: Path, expected: dict[int, tuple[Episode, bool]]) -> None:
    """From the first on that is there, every episode is the one that is expected, bit for bit."""
    played = len(expected)
    problems: list[Problem] = []
    got = [it for it in load_episodes([bag], report=problems.append) if it.number < played]
    assert any(episode.faults.any() for episode, _ in expected.values())
    for recorded in got:
        compare(expected, recorded)
    numbers = sorted(one.number for one in got)
    assert numbers == [*range(played)][-len(numbers) :], problems
    assert len(numbers) >= played - MISSED, problems


@pytest.mark.parametrize(
    ("crash", "episodes", "epsilon"),
    [
        (RANDOM, 20, 0.0),
        pytest.param(MUTE, 5, 1.0, marks=pytest.mark.soak),
        pytest.param(BLIND, 5, 0.3, marks=pytest.mark.soak),
    ],
    ids=["random", "mute", "blind"],
)
def test_a_recording_equals_the_rollout(
    tmp_path: Path, ros_env: dict[str, str], crash: CoachConfig, episodes: int, epsilon: float
) -> None:
    check_recording(tmp_path, int(ros_env["ROS_DOMAIN_ID"]), crash, episodes, epsilon)


@pytest.mark.soak
def test_500_recorded_episodes_equal_the_rollout(tmp_path: Path, ros_env: dict[str, str]) -> None:
    check_recording(tmp_path, int(ros_env["ROS_DOMAIN_ID"]), RANDOM, 500)


def shuffled(bag: Path, folder: Path) -> Path:
    """The recording's messages in any order, in two files."""
    folder.mkdir()
    sent = []
    records: dict[str, dict[str, str]] = {}
    for path in sorted(bag.glob("*.mcap")):
        with path.open("rb") as stream:
            reader = make_reader(stream)
            sent += list(reader.iter_messages(log_time_order=False))
            records |= {record.name: record.metadata for record in reader.iter_metadata()}
    order = np.random.default_rng(SEED).permutation(len(sent))
    for number, part in enumerate(np.array_split(order, 2)):
        with (folder / f"{number}.mcap").open("wb") as stream:
            writer = Writer(stream)
            writer.start(profile="ros2")
            channels: dict[str, int] = {}
            for schema, channel, message in (sent[i] for i in part):
                assert schema is not None
                if channel.topic not in channels:
                    known = writer.register_schema(schema.name, schema.encoding, schema.data)
                    channels[channel.topic] = writer.register_channel(
                        channel.topic, channel.message_encoding, known, channel.metadata
                    )
                writer.add_message(
                    channels[channel.topic], message.log_time, message.data, message.publish_time
                )
            for name, data in records.items():
                writer.add_metadata(name, data)
            writer.finish()  # type: ignore[no-untyped-call]
    return folder


def start(out: Path, env: dict[str, str], parameters: dict[str, object]) -> subprocess.Popen[str]:
    values = {"out": str(out), "robots": ["robot_1"]} | parameters
    arguments = ros_arguments([], "", values)  # type: ignore[arg-type]
    return subprocess.Popen(
        [sys.executable, "-m", "policy_pkg.ros.recorder_node", *arguments],
        env={**os.environ, **env},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_sigterm_ends_the_file(tmp_path: Path, ros_env: dict[str, str]) -> None:
    child = start(tmp_path / "bag", ros_env, {})
    assert child.stderr is not None
    assert "recording" in child.stderr.readline()
    child.send_signal(signal.SIGTERM)
    out, err = child.communicate(timeout=100)
    assert (child.returncode, err) == (0, "")
    assert out.startswith("recorder: 0 messages, 0 episodes")
    assert (tmp_path / "bag" / "bag_0.mcap").read_bytes().endswith(b"\x89MCAP0\r\n")
    json.loads((tmp_path / "bag" / "metadata.yaml").read_text())


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"robots": ["1st"]}, "every robot needs a name of its own"),
        ({"compresion": "zstd"}, "unknown parameter 'compresion'"),
        ({"split_bytes": -1}, "parameter split_bytes = -1"),
        ({"out": ""}, "parameter 'out' of recorder is missing"),
    ],
)
def test_wrong_parameters_are_one_line(
    tmp_path: Path, ros_env: dict[str, str], parameters: dict[str, object], text: str
) -> None:
    child = start(tmp_path / "bag", ros_env, parameters)
    _, err = child.communicate(timeout=100)
    assert child.returncode == 1
    assert err.count("\n") == 1
    assert text in err
