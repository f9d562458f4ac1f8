"""Benchmark rows of recordings: a big team recorded live, and a big recording read.

Run alone: ``python -m benchmarks.bench_bags [MEGABYTES]``, the size of the recording that is read
(2000 for the full size; `make bench` takes 60).
"""

from __future__ import annotations

import json
import resource
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from ament_index_python.packages import get_package_share_directory
from crash_coach_interfaces.msg import Action, EpisodeState, Observation
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from std_msgs.msg import Header

from crash_coach_bringup.ros.client import GraphClient, graph_client
from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_bringup.ros.graph import Process, graph_environment, ros_arguments
from crash_coach_bringup.ros.supervisor import Supervisor
from policy_pkg.bags.about import About
from policy_pkg.bags.dataset import load_episodes
from policy_pkg.bags.topics import OF_ROBOT, Kind, connections, load_typestore
from policy_pkg.bags.writer import BagWriter, Split
from policy_pkg.ros.recorder_node import PROFILE, PROFILE_VARIABLE
from sim_pkg.env import make_env
from sim_pkg.ros.convert import EpisodeWriter, ObservationWriter
from sim_pkg.session import Session
from sim_pkg.trajectory import TrajectoryHash

Row = dict[str, Any]
ROBOTS, RATE_HZ, LIVE_S = 32, 100.0, 6.0
OBS_SIZE, N_ACTIONS = 60, 10
START_S = 60.0
SCENARIO = "skirmish/8m"
MEGABYTES = 60
_EPISODE_AT = 20  # encapsulation 4, stamp 8, frame_id 4 + 4
_U32 = struct.Struct("<I")
TARGET_MESSAGES_PER_S, TARGET_MB = 20_000, 500


class LiveTeam:
    """Publishes what a team of ROBOTS and its graph send in every control step."""

    def __init__(self, client: GraphClient, robots: list[str]) -> None:
        pub, qos = client.node.create_publisher, QoSProfile(depth=1)
        features = np.zeros(OBS_SIZE, np.float32)
        observation = Observation(features=features, available_actions=bytes(N_ACTIONS))
        sent = (
            ("observation", Observation, serialize_message(observation)),
            ("command_raw", Action, serialize_message(Action())),
            ("command", Action, serialize_message(Action())),
        )
        self.pairs = [
            (pub(msgtype, f"/{robot}/{topic}", qos), data)
            for robot in robots
            for topic, msgtype, data in sent
        ]

    def matched(self) -> bool:
        return all(publisher.get_subscription_count() > 0 for publisher, _ in self.pairs)

    def run(self) -> int:
        """Publishes at RATE_HZ for LIVE_S; returns the number of messages."""
        start, ticks = time.perf_counter(), round(LIVE_S * RATE_HZ)
        for tick in range(ticks):
            for publisher, data in self.pairs:
                publisher.publish(data)
            time.sleep(max(0.0, start + (tick + 1) / RATE_HZ - time.perf_counter()))
        return ticks * len(self.pairs)


def environment(domain: int) -> dict[str, str]:
    """The recorder's own profile, which a bare `crash-coach record` uses."""
    return {**graph_environment(domain), PROFILE_VARIABLE: str(PROFILE)}


def recorded_live(folder: Path) -> tuple[int, int, float, float]:
    """(sent, recorded, CPU share of the recorder in one core, rate reached) of a live team."""
    robots = [f"robot_{i + 1}" for i in range(ROBOTS)]
    arguments = ros_arguments([], "", {"out": str(folder / "live"), "robots": robots})
    recorder = Process(
        "recorder", (sys.executable, "-m", "policy_pkg.ros.recorder_node", *arguments)
    )
    with (
        reserve_domain() as domain,
        Supervisor([recorder], folder / "logs", environment(domain)) as supervisor,
        graph_client("team", domain) as client,
    ):
        team = LiveTeam(client, robots)
        client.until(team.matched, START_S, "the recorder")
        client.pause(1.0)
        process = psutil.Process(supervisor.pids()["recorder"])
        before, start = sum(process.cpu_times()[:2]), time.perf_counter()
        sent = team.run()
        wall_s = time.perf_counter() - start
        client.pause(1.0)
        cpu_s = sum(process.cpu_times()[:2]) - before
    text = (folder / "live" / "metadata.yaml").read_text()
    metadata = json.loads(text)["rosbag2_bagfile_information"]
    return sent, metadata["message_count"], cpu_s / wall_s, sent / wall_s


class Pattern:
    """An episode's messages, to be written again under any episode number."""

    def __init__(self, session: Session, rng: np.random.Generator) -> None:
        spec = session.env.spec
        header = Header(frame_id="map")
        observations = ObservationWriter(spec, header)
        states = EpisodeWriter(spec, session.seed, header)
        self.messages: list[tuple[str, bytes]] = []
        self.seed = session.seed
        self._steps: list[tuple[Any, ...]] = []
        session.begin()
        while session.running:
            observations.fill(session)
            self._state(states, session)
            seen = session.obs.copy(), session.state.copy()
            actions = [int(rng.choice(np.flatnonzero(row))) for row in session.available]
            for i, robot in enumerate(spec.robots):
                action = Action(header=header, step=session.step, action=actions[i])
                self.messages.append((f"/{robot}/observation", observations.messages[i]))
                data = serialize_message(action)
                self.messages += [(f"/{robot}/{name}", data) for name in ("command_raw", "command")]
            session.advance(np.array(actions, np.int32), np.zeros(spec.n_robots, np.uint8))
            flags = (session.terminated, session.truncated, session.success)
            self._steps.append((*seen, session.last_actions.copy(), session.reward, *flags))
        self._hash = session.trajectory_hash.encode()
        self._state(states, session)

    def _state(self, states: EpisodeWriter, session: Session) -> None:
        message: EpisodeState = states.fill(session)
        self.messages.append(("/sim/episode", serialize_message(message)))

    def numbered(self, episode: int) -> Iterator[tuple[str, bytes]]:
        digest = TrajectoryHash(self.seed, episode)
        for obs, state, *outcome in self._steps:
            digest.observe(obs, state)
            digest.act(*outcome)
        number, text = _U32.pack(episode), digest.hexdigest().encode()
        for topic, data in self.messages:
            patched = data[:_EPISODE_AT] + number + data[_EPISODE_AT + 4 :]
            yield topic, patched.replace(self._hash, text)


def write_big(folder: Path, megabytes: int) -> int:
    """A recording of about that size, uncompressed; returns its robot-messages."""
    env = make_env(SCENARIO, 1)
    spec, rng = env.spec, np.random.default_rng(0)
    session = Session(env, 0, 0)
    patterns = [Pattern(session, rng) for _ in range(4)]
    store = load_typestore(Path(get_package_share_directory("crash_coach_interfaces")) / "msg")
    topics = connections(spec.robots, False, spec.episode_limit)
    index = {c.topic: i for i, c in enumerate(topics)}
    about = About(robots=spec.robots, scenario=SCENARIO, seed=0)
    writer = BagWriter(
        folder, topics, store, about, time.monotonic, Split(bytes=1 << 30), compression="none"
    )
    written = episode = count = 0
    names = {kind.value for kind in OF_ROBOT if kind is not Kind.SEEN}
    while written < megabytes * 1_000_000:
        for topic, data in patterns[episode % len(patterns)].numbered(episode):
            writer.write(index[topic], written, 0, data)
            written += len(data)
            count += topic.rpartition("/")[2] in names
        episode += 1
    writer.close()
    return count


def read(folder: Path) -> None:
    """Reads a recording strictly; prints what it took."""
    start = time.process_time()
    episodes = sum(1 for _ in load_episodes([folder], strict=True))
    cpu_s = time.process_time() - start
    peak_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(json.dumps({"episodes": episodes, "cpu_s": cpu_s, "peak_mb": peak_kb / 1000}))


def rows(megabytes: int = MEGABYTES) -> list[Row]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sent, recorded, share, rate = recorded_live(folder)
        count = write_big(folder / "big", megabytes)
        command = [sys.executable, "-m", "benchmarks.bench_bags", "read", str(folder / "big")]
        out = subprocess.run(command, check=True, capture_output=True, text=True, timeout=3600)
        result = json.loads(out.stdout)
    per_s = count / result["cpu_s"]
    live = f"{ROBOTS} robots at {RATE_HZ:.0f} Hz"
    return [
        _row(f"recorder, {live}: sent", rate, "messages/s", None, None),
        _row(f"recorder, {live}: lost", sent - recorded, "messages", 0, sent == recorded),
        _row(f"recorder, {live}: CPU", share, "cores", None, None),
        _row(
            f"reading {megabytes} MB", per_s, "robot-messages/s per core", TARGET_MESSAGES_PER_S,
            per_s >= TARGET_MESSAGES_PER_S,
        ),
        _row(
            f"reading {megabytes} MB: peak memory", result["peak_mb"], "MB", TARGET_MB,
            result["peak_mb"] <= TARGET_MB,
        ),
    ]  # fmt: skip


def _row(name: str, value: float, unit: str, target: float | None, ok: bool | None) -> Row:
    return {
        "name": name, "value": value, "unit": unit, "reference": None, "ratio": None,
        "target": target, "ok": ok,
    }  # fmt: skip


def main() -> None:
    if sys.argv[1:2] == ["read"]:
        read(Path(sys.argv[2]))
        return
    for row in rows(int(sys.argv[1]) if len(sys.argv) > 1 else MEGABYTES):
        print(row)


if __name__ == "__main__":
    main()
