"""A graph on two hosts whose link is cut in mid-episode; prints what was seen as JSON.

Runs in a network namespace of its own, the near host, and makes another, the far host, joined by a
veth pair: ``unshare --map-root-user --net --fork --kill-child python network_cut.py FOLDER``.
Namespaces go when their last process does. Sim, gate, coach and the first robot's policy are near,
the other robot's policy is far. Exit code 77: this machine does not permit the two hosts.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from crash_coach_interfaces.msg import EpisodeState
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile

from crash_coach_bringup.ros.client import GraphClient, graph_client
from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_bringup.ros.graph import (
    Process,
    UpOptions,
    check_team,
    graph_environment,
    graph_nodes,
    node_process,
)
from crash_coach_bringup.ros.supervisor import Supervisor
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

NOT_PERMITTED = 77
SCENARIO = "buttons"
NEAR, FAR = "robot_1", "robot_2"
PERIOD_S = 0.2  # of control steps
CMD_TIMEOUT_S = 3 * PERIOD_S
WAIT_S = 60.0
MOVING_SEED = 2  # weights with which both robots keep moving
STILL_STEPS = 5  # so many stays in a row are no policy's choice


def ip(*arguments: str, far: tuple[str, ...] = ()) -> str:
    done = subprocess.run(
        [*far, "ip", *arguments], capture_output=True, text=True, timeout=10, check=True
    )
    return done.stdout


def wait_for(ready: Callable[[], bool], what: str, timeout_s: float = 10.0) -> None:
    end = time.monotonic() + timeout_s
    while not ready():
        if time.monotonic() > end:
            raise TimeoutError(f"waited {timeout_s} s for {what}")
        time.sleep(0.02)


@contextmanager
def far_host(folder: Path) -> Iterator[tuple[str, ...]]:
    """Yields what has to stand before a command to run it there."""
    holder = Process("far", ("unshare", "--net", "sleep", "infinity"))
    with Supervisor([holder], folder / "hosts", {}) as supervisor:
        pid = supervisor.pids()["far"]
        wait_for(
            lambda: os.readlink(f"/proc/{pid}/ns/net") != os.readlink("/proc/self/ns/net"),
            "the far host",
        )
        far = ("nsenter", "--target", str(pid), "--net")
        ip("link", "add", "near0", "type", "veth", "peer", "name", "far0", "netns", str(pid))
        for name, address, host in (("near0", "10.77.0.1/24", ()), ("far0", "10.77.0.2/24", far)):
            ip("link", "set", "lo", "up", far=host)
            ip("address", "add", address, "dev", name, far=host)
            ip("link", "set", name, "up", far=host)
        # DDS looks for interfaces that run once, as a process starts.
        wait_for(
            lambda: json.loads(ip("-j", "link", "show", "near0"))[0]["operstate"] == "UP", "up"
        )
        wait_for(
            lambda: json.loads(ip("-j", "link", "show", "far0", far=far))[0]["operstate"] == "UP",
            "up",
        )
        yield far


@dataclass
class Watch:
    """What the graph says of itself: (time, ...) in order."""

    client: GraphClient
    stays: frozenset[int]
    actions: list[tuple[float, tuple[int, ...], tuple[int, ...]]] = field(default_factory=list)
    status: list[tuple[float, str, str]] = field(default_factory=list)

    def listen(self) -> None:
        node = self.client.node
        node.create_subscription(EpisodeState, "/sim/episode", self._on_state, QoSProfile(depth=10))
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_status, 10)

    def _on_state(self, message: EpisodeState) -> None:
        if message.actions:
            now_s = time.monotonic()
            self.actions.append((now_s, tuple(message.actions), tuple(message.crashed)))

    def _on_status(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.status.append((time.monotonic(), status.name, status.message))

    def said(self, after_s: float, name: str, words: str) -> float:
        """Waits for a status; seconds until it came."""

        def times() -> list[float]:
            return [at - after_s for at, who, text in self.status
                    if at > after_s and who == name and words in text]  # fmt: skip

        self.client.until(lambda: bool(times()), WAIT_S, f"{name}: {words}")
        return times()[0]

    def moving(self, robot: int) -> Callable[[], bool]:
        """Whether one of the robot's last actions was no stay."""
        return lambda: any(
            actions[robot] not in self.stays for _, actions, _ in self.actions[-STILL_STEPS:]
        )

    def still(self, robot: int) -> bool:
        return len(self.actions) >= STILL_STEPS and not self.moving(robot)()

    def last_move_s(self, robot: int, after_s: float) -> float:
        """Seconds from ``after_s`` to the last action that was no stay; 0 without."""
        moves = [at for at, actions, _ in self.actions
                 if at > after_s and actions[robot] not in self.stays]  # fmt: skip
        return moves[-1] - after_s if moves else 0.0


def play(folder: Path, far: tuple[str, ...]) -> dict[str, object]:
    spec = make_env(SCENARIO, 1).spec
    checkpoint = folder / "step_0"
    write_untrained(checkpoint, spec, seed=MOVING_SEED)
    sim = {"cmd_timeout_s": CMD_TIMEOUT_S, "real_time_factor": spec.dt_s / PERIOD_S}
    options = UpOptions(SCENARIO, checkpoint, mode="realtime", sim=sim)
    processes = [node_process(node) for node in graph_nodes(options, check_team(options))]
    processes = [
        Process(p.name, (*far, *p.argv)) if p.name == f"policy_{FAR}" else p for p in processes
    ]
    # UDP alone: two hosts share no memory, two namespaces of one machine may.
    os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SUBNET"
    with (
        reserve_domain() as domain,
        Supervisor(processes, folder / "logs", graph_environment(domain)) as supervisor,
    ):

        def check() -> None:
            for ended in supervisor.wait(0.0):
                raise RuntimeError(ended.describe())

        with graph_client("watch", domain, check) as client:
            watch = Watch(client, frozenset(spec.stay_actions))
            watch.listen()
            return cut_and_mend(watch)


def cut_and_mend(watch: Watch) -> dict[str, object]:
    until = watch.client.until
    until(lambda: len(watch.actions) > STILL_STEPS, 30.0, "control steps")
    until(watch.moving(1), WAIT_S, "the far robot on its way")
    watch.said(0.0, f"sim: {FAR}", "ok")
    watch.said(0.0, f"gate: {FAR}", "ok")
    ip("link", "set", "near0", "down")
    cut_s = time.monotonic()
    sim_lost_s = watch.said(cut_s, f"sim: {FAR}", "lost")
    gate_lost_s = watch.said(cut_s, f"gate: {FAR}", "lost")
    until(lambda: watch.still(1), WAIT_S, "the far robot at rest")
    stopped_s = watch.last_move_s(1, cut_s)
    near_moves_s = watch.last_move_s(0, cut_s)
    ip("link", "set", "near0", "up")
    mended_s = time.monotonic()
    until(watch.moving(1), WAIT_S, "the far robot on its way again")
    moving_s = time.monotonic() - mended_s
    watch.said(mended_s, f"sim: {FAR}", "ok")
    watch.said(mended_s, f"gate: {FAR}", "ok")
    return {
        "stopped_s": stopped_s,
        "near_moves_s": near_moves_s,
        "sim_lost_s": sim_lost_s,
        "gate_lost_s": gate_lost_s,
        "moving_s": moving_s,
        "said": sorted({(who, text) for at, who, text in watch.status if cut_s < at < mended_s}),
        "crashed": any(any(crashed) for _, _, crashed in watch.actions),
    }


def main() -> int:
    folder = Path(sys.argv[1])
    try:
        with far_host(folder) as far:
            print(json.dumps(play(folder, far)))
    except (subprocess.CalledProcessError, FileNotFoundError) as error:
        reason = getattr(error, "stderr", None) or error
        print(f"no two hosts on this machine: {reason}", file=sys.stderr)
        return NOT_PERMITTED
    return 0


if __name__ == "__main__":
    sys.exit(main())
