"""Benchmark rows of the gate's delay: through a gate against a direct topic, in the same run.

Run alone: ``python benchmarks/bench_gate.py``. A driver process sends numbered, timed Twists, in
turn on a direct topic and on one that the gate relays; the bench receives both. The direct
topic's delay is the reference of each row.
"""

from __future__ import annotations

import json
import struct
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist
from rclpy.clock import Clock, ClockType
from rclpy.qos import QoSProfile

from crash_coach_bringup.ros.client import GraphClient, graph_client
from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_bringup.ros.graph import (
    Node,
    Process,
    Value,
    graph_environment,
    node_process,
)
from crash_coach_bringup.ros.supervisor import Supervisor

TYPE = "geometry_msgs/msg/Twist"
ROBOTS = (1, 8, 32)
RATES_HZ = (10, 100)
MEASURED_S = 4.0
WARM_UP_S = 1.0
WAIT_S = 60.0
# A tenth of the shortest period. Of more robots that command at once some wait for the others.
TARGET_P50_US = 1000
JUDGED_ROBOTS = 8
# A second of the highest rate: what is measured is the delay, also where the machine stalls.
DEPTH = 100
QOS = QoSProfile(depth=DEPTH)
# A serialized Twist: encapsulation, then six doubles; linear is (number, time sent, 0).
_NUMBERED = struct.Struct("<dd")
_ENCAPSULATION_SIZE = 4

Row = dict[str, Any]


def names(robots: int) -> tuple[str, ...]:
    return tuple(f"robot_{i + 1}" for i in range(robots))


def drive(robots: int, rate_hz: float, warm_up: int, count: int) -> None:
    """Sends ``warm_up + count`` commands per robot and path, then waits until all have arrived."""
    with graph_client("driver") as client:
        direct = [client.node.create_publisher(Twist, f"/{n}/direct", QOS) for n in names(robots)]
        relayed = [
            client.node.create_publisher(Twist, f"/{n}/cmd_vel_raw", QOS) for n in names(robots)
        ]
        both = (*direct, *relayed)
        client.until(
            lambda: all(p.get_subscription_count() > 0 for p in both), WAIT_S, "gate and bench"
        )
        client.pause(0.5)  # both sides of a match are told one after the other
        ticks = 0

        def on_tick() -> None:
            nonlocal ticks
            message = Twist()
            message.linear.x = float(ticks // 2)
            for publisher in relayed if ticks % 2 else direct:
                message.linear.y = time.monotonic()
                publisher.publish(message)
            ticks += 1

        # The paths take turns, so that neither waits for the other's burst.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        timer = client.node.create_timer(0.5 / rate_hz, on_tick, clock=steady)
        goal = 2 * (warm_up + count)
        client.until(lambda: ticks >= goal, WAIT_S, "the commands")
        client.node.destroy_timer(timer)
        client.pause(1.0)  # the last ones are still under way


@dataclass
class Stream:
    """What arrived on one kind of topic: delays in seconds, numbers of each robot."""

    delays_s: list[float] = field(default_factory=list)
    numbers: dict[str, list[int]] = field(default_factory=dict)
    lost: int = 0  # behind the warm-up

    def on_message(self, name: str, data: bytes) -> None:
        now_s = time.monotonic()
        number, sent_s = _NUMBERED.unpack_from(data, _ENCAPSULATION_SIZE)
        self.numbers[name].append(int(number))
        self.delays_s.append(now_s - sent_s)

    def lost_of(self, wanted: range) -> int:
        return sum(len(set(wanted).difference(numbers)) for numbers in self.numbers.values())

    def percentile_us(self, percent: float) -> float:
        return float(1e6 * np.percentile(self.delays_s, percent))


def measure(
    client: GraphClient, folder: Path, domain: int, robots: int, rate_hz: int
) -> tuple[Stream, Stream]:
    """(direct, through the gate)."""
    count, warm_up = round(MEASURED_S * rate_hz), round(WARM_UP_S * rate_hz)
    direct, relayed = Stream(), Stream()
    subscriptions = []
    for path, topic in ((direct, "direct"), (relayed, "cmd_vel")):
        for name in names(robots):
            path.numbers[name] = []
            on_message: Callable[[bytes], None] = partial(path.on_message, name)
            subscriptions.append(
                client.node.create_subscription(
                    Twist, f"/{name}/{topic}", on_message, QOS, raw=True
                )
            )
    arguments = [str(v) for v in (robots, rate_hz, warm_up, count)]
    driver = Process("driver", (sys.executable, str(Path(__file__).resolve()), *arguments))
    with Supervisor(
        [driver], folder / f"driver_{robots}_{rate_hz}", graph_environment(domain)
    ) as s:
        ended: list[Any] = []

        def done() -> bool:
            ended.extend(s.wait(0.0))
            return bool(ended)

        client.until(done, WAIT_S, "the driver")
        if ended[0].exit_code != 0:
            raise RuntimeError(ended[0].describe())
    for subscription in subscriptions:
        client.node.destroy_subscription(subscription)
    for path in (direct, relayed):
        del path.delays_s[: warm_up * robots]
        path.lost = path.lost_of(range(warm_up, warm_up + count))
    return direct, relayed


def delay_row(direct: Stream, relayed: Stream, percent: int, robots: int, rate_hz: int) -> Row:
    through, bare = relayed.percentile_us(percent), direct.percentile_us(percent)
    judged = percent == 50 and robots <= JUDGED_ROBOTS
    return {
        "name": f"gate added latency p{percent}, {robots} robots, {rate_hz} Hz",
        "value": round(through - bare, 1),
        "unit": "us",
        "reference": round(bare, 1),
        "ratio": round(through / bare, 3),
        "target": f"< {TARGET_P50_US:g}" if judged else None,
        "ok": through - bare < TARGET_P50_US if judged else None,
    }


def rows() -> list[Row]:
    """All rows: {name, value, unit, reference, ratio, target, ok}."""
    result: list[Row] = []
    lost = lost_directly = 0
    parameters: dict[str, Value] = {
        "robots": names(max(ROBOTS)),
        "command_type": TYPE,
        "depth": DEPTH,
    }
    gate = node_process(Node("gate", "crash_coach_pkg", "gate", parameters))
    with (
        tempfile.TemporaryDirectory(prefix="crash_coach_bench_") as text,
        reserve_domain() as domain,
    ):
        folder = Path(text)
        with (
            Supervisor([gate], folder / "gate", graph_environment(domain)) as supervisor,
            graph_client("bench", domain, lambda: refuse_dead(supervisor)) as client,
        ):
            for robots in ROBOTS:
                for rate_hz in RATES_HZ:
                    direct, relayed = measure(client, folder, domain, robots, rate_hz)
                    lost_directly += direct.lost
                    lost += relayed.lost
                    result += [delay_row(direct, relayed, p, robots, rate_hz) for p in (50, 99)]
    return [*result, lost_row(lost, lost_directly)]


def refuse_dead(supervisor: Supervisor) -> None:
    for ended in supervisor.wait(0.0):
        raise RuntimeError(ended.describe())


def lost_row(lost: int, directly: int) -> Row:
    return {
        "name": "gate lost messages, all of these",
        "value": lost,
        "unit": "messages",
        "reference": directly,
        "ratio": None,
        "target": "0",
        "ok": lost == 0,
    }


if __name__ == "__main__":
    if len(sys.argv) == 5:
        robots, rate_hz, warm_up, count = (int(text) for text in sys.argv[1:])
        drive(robots, rate_hz, warm_up, count)
    else:
        for row in rows():
            print(json.dumps(row))
