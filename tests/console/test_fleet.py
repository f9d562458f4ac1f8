"""Robots that this project does not simulate, and what the console reads of the wire."""

from __future__ import annotations

import asyncio
import json
import math
import time
from collections.abc import Callable
from typing import Any

import pytest
from coach_graph import process
from crash_coach_interfaces.msg import FaultEvent
from geometry_msgs.msg import Quaternion, Twist
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from std_msgs.msg import Header

from crash_coach_bringup.ros.client import graph_client
from crash_coach_console.board import Cursor
from crash_coach_console.fleet import Fleet
from crash_coach_console.requests import parse_request
from crash_coach_console.ros.convert import event_kind, yaw_rad
from crash_coach_console.ros.graph_source import GraphSource

ROVERS = ("rover_east", "rover_west")
WAIT_S = 60.0


def test_robots_are_drawn_where_they_say_they_are() -> None:
    fleet = Fleet(ROVERS)
    fleet.told("rover_west", (math.nan, 0.0, 0.0), 1.0)
    fleet.told("somebody", (1.0, 0.0, 0.0), 1.0)
    assert not fleet.moved
    fleet.told("rover_west", (-3.0, 7.5, 0.5), 2.0)
    assert fleet.grown
    arena = fleet.arena()
    assert arena.robots == ("rover_west",)
    assert arena.walled_m == (-5.0, 0.0, 0.0, 10.0)
    state = fleet.state(("rover_west",))
    assert (state.poses, state.crashed, state.time_s) == ((-3.0, 7.5, 0.5), (1,), 2.0)
    fleet.told("rover_west", (-3.5, 7.0, 0.5), 3.0)
    assert not fleet.grown
    fleet.told("rover_east", (1.0, 1.0, 0.0), 3.0)
    assert fleet.arena().robots == ROVERS


@pytest.mark.parametrize("frame_id", ["", "map", "a_frame"])
@pytest.mark.parametrize("kind", range(7))
def test_the_kind_of_an_event_is_the_one_that_was_sent(frame_id: str, kind: int) -> None:
    event = FaultEvent(header=Header(frame_id=frame_id), kind=kind, robot="robot_1", mode="mute")
    data = bytes(serialize_message(event))
    assert event_kind(data) == kind
    assert event_kind(data[:15]) == event_kind(b"") == event_kind(b"\0\0" + data[2:]) == -1


def test_a_turn_about_the_vertical() -> None:
    for yaw in (-3.0, 0.0, 0.7, 2.5):
        turn = Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2))
        assert yaw_rad(turn) == pytest.approx(yaw)


def shown(source: GraphSource) -> dict[str, Any]:
    return {m["type"]: m for m in map(json.loads, source.board.since(Cursor()))}


def test_a_fleet_of_ones_own_is_listed_drawn_and_crashed(ros_env: dict[str, str]) -> None:
    domain = int(ros_env["ROS_DOMAIN_ID"])
    gate: dict[str, object] = {"command_type": "geometry_msgs/msg/Twist", "dt_s": 0.05}
    source = GraphSource(0, "fleet", domain)
    with (
        process(ros_env, "gate", robots=ROVERS, **gate),
        process(ros_env, "coach", robots=ROVERS, follow_sim=False, dt_s=0.05),
        graph_client("rovers", domain) as client,
    ):
        pub = client.node.create_publisher
        raws = [pub(Twist, f"/{name}/cmd_vel_raw", 10) for name in ROVERS]
        places = [pub(Odometry, f"/{name}/odom", 10) for name in ROVERS]
        got: list[Twist] = []
        client.node.create_subscription(Twist, "/rover_east/cmd_vel", got.append, 100)

        def until(ready: Callable[[], bool], what: str) -> None:
            end_s = time.monotonic() + WAIT_S
            while not ready():
                assert time.monotonic() < end_s, what
                for k, (raw, place) in enumerate(zip(raws, places, strict=True)):
                    raw.publish(Twist())
                    odometry = Odometry()
                    odometry.pose.pose.position.x = 2.0 + k
                    odometry.pose.pose.orientation.w = 1.0
                    place.publish(odometry)
                client.pause(0.05)

        async def ask(**fields: Any) -> str:
            return await source.act(parse_request(json.dumps({"id": 0, "source": 0, **fields})))

        source.start()
        try:
            until(lambda: shown(source).get("status", {}).get("ready", False), "a coach")
            until(lambda: len(shown(source).get("arena", {}).get("actors", [])) == 2, "the rovers")
            until(lambda: bool(got), "commands")
            names = [robot["name"] for robot in shown(source)["team"]["robots"]]
            assert names == list(ROVERS)
            assert shown(source)["state"]["poses"] == [2.0, 0.0, 0.0, 3.0, 0.0, 0.0]
            said = asyncio.run(ask(type="inject", victims=["rover_east"], mode="mute"))
            assert said.startswith("rover_east: mute from the next step on (armed at step")
            until(lambda: shown(source)["team"]["robots"][0]["state"] == "faulted", "a muted rover")
            until(lambda: shown(source)["state"]["crashed"] == [1, 0], "it is drawn as crashed")
            asyncio.run(ask(type="clear"))
            until(lambda: shown(source)["team"]["robots"][0]["state"] == "ok", "cleared")
        finally:
            source.close()
