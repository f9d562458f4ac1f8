"""Benchmark rows of the ROS graph: lock-step control steps per second.

Run alone: ``python benchmarks/bench_ros.py``. The reference of every rate is a bare
request-reply between two processes, the same message type, measured in the same run.
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from crash_coach_interfaces.msg import Action, EpisodeState
from rclpy.qos import QoSProfile

from crash_coach_bringup.ros.client import GraphClient, graph_client
from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_bringup.ros.graph import (
    Layout,
    Process,
    UpOptions,
    graph_environment,
    graph_processes,
)
from crash_coach_bringup.ros.supervisor import Supervisor
from crash_coach_common.contract import EnvSpec
from crash_coach_pkg.team import TeamSpec
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

WINDOW_S = 4.0
WARM_UP_S = 1.0
START_S = 60.0
ROUND_TRIPS = 3000
SCENARIOS = {2: "buttons", 8: "buttons_8", 16: "buttons_16"}
# Least parts of the bare request-reply's rate, with the gate.
TARGET_RATIOS = {(8, "team"): 0.25, (16, "nodes"): 0.08}
TARGET_GATE_COST = 0.20
PAIRS = 5  # of graphs with and without the gate, in turn: the machine's speed wanders
GRAPHS = 3  # whose median a row with a target is

Row = dict[str, Any]


def reply() -> None:
    """The other end of the request-reply: sends back what it gets, until it is killed."""
    with graph_client("replier") as client:
        publisher = client.node.create_publisher(Action, "/pong", QoSProfile(depth=1))
        client.node.create_subscription(Action, "/ping", publisher.publish, QoSProfile(depth=1))
        client.until(lambda: False, 600, "the end of the benchmark")


class Pinger:
    """Publishes the next request from the callback of the answer to the one before."""

    def __init__(self, client: GraphClient) -> None:
        self.client = client
        self.answers = 0
        self.publisher = client.node.create_publisher(Action, "/ping", QoSProfile(depth=1))
        self.subscription = client.node.create_subscription(
            Action, "/pong", self.on_pong, QoSProfile(depth=1)
        )

    def on_pong(self, message: Action) -> None:
        self.answers += 1
        self.publisher.publish(message)

    def rate(self) -> float:
        self.client.until(
            lambda: (
                self.publisher.get_subscription_count() > 0
                and self.subscription.get_publisher_count() > 0
            ),
            START_S,
            "the replier",
        )
        self.client.pause(WARM_UP_S)
        self.publisher.publish(Action())
        self.client.until(lambda: self.answers > ROUND_TRIPS // 10, START_S, "warm-up")
        first, start = self.answers, time.perf_counter()
        self.client.until(lambda: self.answers >= first + ROUND_TRIPS, START_S, "the replies")
        return (self.answers - first) / (time.perf_counter() - start)


def request_reply_per_s(folder: Path) -> float:
    here = str(Path(__file__).resolve())
    replier = Process("replier", (sys.executable, here, "reply"))
    with (
        reserve_domain() as domain,
        Supervisor([replier], folder, graph_environment(domain), throughput=True) as supervisor,
        graph_client("pinger", domain, lambda: refuse_dead(supervisor, 0.0)) as client,
    ):
        return Pinger(client).rate()


def refuse_dead(supervisor: Supervisor, timeout_s: float) -> None:
    """Waits; raises RuntimeError where a process ended meanwhile."""
    for ended in supervisor.wait(timeout_s):
        raise RuntimeError(ended.describe())


def sample(client: GraphClient, dt_s: float) -> tuple[float, float]:
    """(seconds, global control step) now. Listens only for as long as that takes."""
    seen: list[tuple[float, float]] = []

    def on_state(message: EpisodeState) -> None:
        stamp = message.header.stamp
        seen.append((time.perf_counter(), (stamp.sec + 1e-9 * stamp.nanosec) / dt_s))

    subscription = client.node.create_subscription(
        EpisodeState, "/sim/episode", on_state, QoSProfile(depth=1)
    )
    client.until(lambda: len(seen) > 0, START_S, "the first step")
    client.node.destroy_subscription(subscription)
    return seen[-1]


def untrained(folder: Path, spec: EnvSpec) -> Path:
    """A checkpoint of the team of so many robots, written once."""
    checkpoint = folder / f"{spec.n_robots}" / "step_0"
    if not checkpoint.exists():
        write_untrained(checkpoint, spec, seed=0)
    return checkpoint


def lockstep_steps_per_s(folder: Path, robots: int, layout: Layout, gate: bool) -> float:
    """Control steps per second of a graph that nobody listens to."""
    scenario = SCENARIOS[robots]
    spec = make_env(scenario, 1).spec
    options = UpOptions(scenario, untrained(folder, spec), layout=layout, gate=gate)
    with (
        reserve_domain() as domain,
        Supervisor(
            graph_processes(options, TeamSpec.of(spec)),
            folder / "logs",
            graph_environment(domain),
            throughput=True,
        ) as supervisor,
        graph_client("meter", domain, lambda: refuse_dead(supervisor, 0.0)) as client,
    ):
        sample(client, spec.dt_s)
        refuse_dead(supervisor, WARM_UP_S)
        start_s, first = sample(client, spec.dt_s)
        refuse_dead(supervisor, WINDOW_S)
        end_s, last = sample(client, spec.dt_s)
    return (last - first) / (end_s - start_s)


def rate_row(name: str, value: float, reference: float, target: float | None = None) -> Row:
    """``target``: the least ratio of value and reference."""
    return {
        "name": name,
        "value": round(value, 1),
        "unit": "steps/s",
        "reference": round(reference, 1),
        "ratio": round(value / reference, 3),
        "target": f"ratio >= {target:g}" if target is not None else None,
        "ok": target is None or value >= target * reference,
    }


def rows() -> list[Row]:
    """All rows: {name, value, unit, reference, ratio, target, ok}."""
    with tempfile.TemporaryDirectory(prefix="crash_coach_bench_") as text:
        folder = Path(text)
        bare = request_reply_per_s(folder)
        result = [
            {
                "name": "ros bare request-reply between two processes",
                "value": round(bare, 1),
                "unit": "round trips/s",
                "reference": round(bare, 1),
                "ratio": 1.0,
                "target": None,
                "ok": True,
            }
        ]
        pairs = gate_pairs(folder)
        with_gate, without = (statistics.median(rates) for rates in zip(*pairs, strict=True))
        layouts: tuple[tuple[Layout, str], ...] = (
            ("team", "team process"),
            ("nodes", "process per robot"),
        )
        for robots in SCENARIOS:
            for layout, label in layouts:
                target = TARGET_RATIOS.get((robots, layout))
                rate = with_gate
                if (robots, layout) != (8, "team"):
                    graphs = range(GRAPHS if target else 1)
                    rate = statistics.median(
                        lockstep_steps_per_s(folder, robots, layout, gate=True) for _ in graphs
                    )
                name = f"ros lock-step {robots} robots, gate, {label}"
                result.append(rate_row(name, rate, bare, target))
        result.append(rate_row("ros lock-step 8 robots, no gate, team process", without, bare))
        result.append(gate_row(pairs))
    return result


def gate_pairs(folder: Path) -> list[tuple[float, float]]:
    """Steps per second with the gate and without it, of 8 robots and a team process."""
    return [
        (
            lockstep_steps_per_s(folder, 8, "team", gate=True),
            lockstep_steps_per_s(folder, 8, "team", gate=False),
        )
        for _ in range(PAIRS)
    ]


def gate_row(pairs: list[tuple[float, float]]) -> Row:
    ratio = statistics.median(with_gate / without for with_gate, without in pairs)
    return {
        "name": "ros cost of the gate, 8 robots, team process",
        "value": round(100 * (1 - ratio), 1),
        "unit": "%",
        "reference": round(statistics.median(without for _, without in pairs), 1),
        "ratio": round(ratio, 3),
        "target": f"< {100 * TARGET_GATE_COST:g}",
        "ok": 1 - ratio < TARGET_GATE_COST,
    }


if __name__ == "__main__":
    if sys.argv[1:] == ["reply"]:
        reply()
    for row in rows():
        print(json.dumps(row))
