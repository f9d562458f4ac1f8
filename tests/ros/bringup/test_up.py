"""`up`: the whole graph as processes; what dies is told, and nothing is left behind."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
from crash_coach_interfaces.msg import EpisodeState
from shared_memory import strike

from crash_coach_bringup.ros.client import graph_client
from crash_coach_bringup.ros.graph import GraphError, UpOptions
from crash_coach_bringup.ros.supervisor import STOPS, Event
from crash_coach_bringup.ros.up import run_up
from crash_coach_common.strict_yaml import ConfigError
from crash_coach_pkg.coach.config import CoachConfig
from policy_pkg.checkpoint import CheckpointError, load_policy
from policy_pkg.play.conditions import crash_free
from policy_pkg.play.evaluate import evaluate
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env
from sim_pkg.ros.sim_lock import only_sim

SOAK = pytest.mark.soak
TOLD_WITHIN_S = 2.0
CALM = {"pace_hz": 50.0}  # leaves the processor to other tests
UP = """
import json, sys
from pathlib import Path
from crash_coach_bringup.ros.graph import UpOptions
from crash_coach_bringup.ros.up import run_up
options = json.loads(sys.argv[1])
for key in ("checkpoint", "log_dir"):
    options[key] = Path(options[key])
tell = lambda event: print(json.dumps([event.kind, event.process, event.text]), flush=True)
sys.exit(run_up(UpOptions(**options), tell))
"""


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("team") / "step_0"
    write_untrained(folder, make_env("buttons", 1).spec, seed=1)
    return folder


class Up:
    """A running `up`, its events and the process ids of its nodes."""

    def __init__(self, child: subprocess.Popen[str]) -> None:
        self.child = child
        self.pids: dict[str, int] = {}
        self.episodes: list[str] = []
        self.summary: list[str] = []

    def event(self) -> tuple[str, str, str]:
        """The next one; what it tells of episodes is kept aside."""
        assert self.child.stdout is not None
        while True:
            kind, process, text = json.loads(self.child.stdout.readline())
            kept = {"episode": self.episodes, "summary": self.summary}.get(kind)
            if kept is None:
                return kind, process, text
            kept.append(text)

    def started(self, count: int) -> None:
        for _ in range(count):
            kind, process, text = self.event()
            assert kind == "started"
            self.pids[process] = int(text.split()[1].rstrip(","))

    def left(self) -> list[int]:
        return [pid for pid in self.pids.values() if psutil.pid_exists(pid)]


@contextmanager
def up(checkpoint: Path, logs: Path, env: dict[str, str], **options: Any) -> Iterator[Up]:
    given = {"scenario": "buttons", "checkpoint": str(checkpoint), "log_dir": str(logs), **options}
    child = subprocess.Popen(
        [sys.executable, "-c", UP, json.dumps(given)], stdout=subprocess.PIPE, text=True, env=env
    )
    try:
        yield Up(child)
    finally:
        if child.poll() is None:
            child.kill()
        child.communicate(timeout=10)


def await_episode() -> None:
    """Until the graph of this domain plays."""
    states: list[EpisodeState] = []
    with graph_client("looker") as client:
        client.node.create_subscription(EpisodeState, "/sim/episode", states.append, 10)
        client.until(lambda: any(s.step > 0 for s in states), 40, "a control step")


@pytest.mark.parametrize(
    "victim",
    ["coach", "policy_robot_1", *(pytest.param(name, marks=SOAK) for name in ("gate", "sim"))],
)
def test_a_node_that_is_killed_is_told_and_ends_the_graph(
    checkpoint: Path, tmp_path: Path, ros_env: dict[str, str], victim: str
) -> None:
    with up(checkpoint, tmp_path, ros_env, sim=CALM) as running:
        running.started(5)
        assert set(running.pids) == {"sim", "coach", "gate", "policy_robot_1", "policy_robot_2"}
        if victim == "coach":
            await_episode()
        killed_s = time.monotonic()
        strike(running.pids[victim])
        kind, process, text = running.event()
        told_s = time.monotonic() - killed_s
        assert (kind, process) == ("died", victim)
        assert f"{victim} died (killed by SIGKILL, log {tmp_path / victim}.log)" in text
        assert told_s < TOLD_WITHIN_S
        assert running.event()[0] == "stopped"
        # Nobody waits for what the dead one would acknowledge, until it is killed itself.
        assert time.monotonic() - killed_s < sum(patience_s for _, patience_s in STOPS[:2])
        assert running.child.wait(20) == 1
        assert running.left() == []


def test_ctrl_c_ends_everything_without_a_trace(
    checkpoint: Path, tmp_path: Path, ros_env: dict[str, str]
) -> None:
    with up(checkpoint, tmp_path, ros_env, sim=CALM) as running:
        running.started(5)
        await_episode()
        running.child.send_signal(signal.SIGINT)
        assert [running.event()[0] for _ in range(2)] == ["interrupted", "stopped"]
        assert running.child.wait(20) == 130
        assert running.left() == []
    # Each says that it is ready, the coach perhaps how a block of episodes went, and nothing else.
    logs = [log.read_text() for log in tmp_path.glob("*.log")]
    calm = re.compile(r"(\[INFO\] \[[\d.]+\] \[\w+\]: (ready|block): [^\n]*\n)+")
    assert [bool(calm.fullmatch(log)) for log in logs] == [True] * 5, logs


@pytest.mark.parametrize(
    ("layout", "mode", "processes"),
    [
        pytest.param("team", "lockstep", 3, marks=SOAK),
        pytest.param("nodes", "realtime", 5, marks=SOAK),
        ("single", "lockstep", 1),
    ],
)
def test_the_last_episode_is_a_good_end(
    checkpoint: Path,
    tmp_path: Path,
    ros_env: dict[str, str],
    layout: str,
    mode: str,
    processes: int,
) -> None:
    sim = {"real_time_factor": 20.0} if mode == "realtime" else {}
    options = {"layout": layout, "mode": mode, "episodes": 2, "sim": sim}
    with up(checkpoint, tmp_path, ros_env, **options) as running:
        running.started(processes)
        assert running.event()[0] == "finished"
        assert running.event()[0] == "stopped"
        assert running.child.wait(20) == 0
        assert running.left() == []
    wanted = evaluate(load_policy(checkpoint), "buttons", crash_free(), 2, 0).episodes
    told = f"return {wanted[0].episode_return:.2f}, {wanted[0].steps} steps; crashed: nobody"
    if mode == "lockstep":  # in real time a command may come too late
        assert running.episodes == [f"episode {k}: no success, {told}" for k in (0, 1)]
    assert [text.split(": ")[0] for text in running.episodes] == ["episode 0", "episode 1"]
    (line,) = running.summary
    assert line.startswith("nobody crashed: 2 episodes, success 0.0 % (")


def test_who_was_crashed_in_each_episode_is_told_and_the_page_served(
    checkpoint: Path, tmp_path: Path, ros_env: dict[str, str]
) -> None:
    options = UpOptions(
        "buttons",
        checkpoint,
        layout="single",
        episodes=3,
        log_dir=tmp_path,
        coach=CoachConfig(strategy="fixed", victims=("robot_2",), crash_mode="random"),
    )
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    events: list[Event] = []
    assert run_up(options, events.append, console=port) == 0
    told = [event.text for event in events if event.kind == "episode"]
    assert [text.partition(": ")[0] for text in told] == ["episode 0", "episode 1", "episode 2"]
    assert all(text.endswith("; crashed: robot_2 (random)") for text in told), told
    (line,) = (event.text for event in events if event.kind == "summary")
    assert line.startswith("robot_2 (random) crashed: 3 episodes")
    assert f"http://127.0.0.1:{port}/" in [e.text for e in events if e.process == "console"]


def test_a_domain_with_a_sim_is_refused(
    checkpoint: Path, tmp_path: Path, ros_env: dict[str, str]
) -> None:
    logs = tmp_path / "logs"
    domain = int(ros_env["ROS_DOMAIN_ID"])
    with only_sim(domain), pytest.raises(GraphError, match=f"another sim .* ROS domain {domain}"):
        run_up(UpOptions("buttons", checkpoint, log_dir=logs), print)
    assert not logs.exists()


def test_what_cannot_work_is_refused_before_anything_starts(
    checkpoint: Path, tmp_path: Path, ros_env: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    logs = tmp_path / "logs"
    with pytest.raises(ConfigError, match="no_such_scenario"):
        run_up(UpOptions("no_such_scenario", checkpoint, log_dir=logs), print)
    with pytest.raises(CheckpointError, match="does not fit scenario 'buttons_8'"):
        run_up(UpOptions("buttons_8", checkpoint, log_dir=logs), print)
    with pytest.raises(CheckpointError, match="no such file"):
        run_up(UpOptions("buttons", tmp_path / "nothing", log_dir=logs), print)
    for domain, text in (("x", "'x', not a number"), ("233", r"233 is not in 0\.\.232")):
        monkeypatch.setenv("ROS_DOMAIN_ID", domain)
        with pytest.raises(GraphError, match=text):
            run_up(UpOptions("buttons", checkpoint, log_dir=logs), print)
    assert not logs.exists()
