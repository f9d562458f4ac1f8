"""The sim's serialized observations and commands, against rclpy's own serialization."""

from __future__ import annotations

import numpy as np
import pytest
from crash_coach_interfaces.msg import Action, EpisodeState, Observation
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from crash_coach_common.contract import UserError
from sim_pkg.env import make_env
from sim_pkg.ros.convert import (
    EpisodeWriter,
    ObservationWriter,
    command_from_bytes,
    markers,
    set_time,
)
from sim_pkg.session import Session


@pytest.mark.parametrize("frame_id", ["", "m", "ma", "map", "base"])
def test_an_observation_holds_what_the_session_says(frame_id: str) -> None:
    env = make_env("buttons", 1)
    session = Session(env, 3, 0)
    header = Header(frame_id=frame_id)
    writer = ObservationWriter(env.spec, header)
    session.begin()
    for step in range(3):
        set_time(header.stamp, step * 1_500_000_000)
        writer.fill(session)
        for robot, data in enumerate(writer.messages):
            message = deserialize_message(data, Observation)
            assert message.header == header
            assert (message.episode, message.step) == (0, step)
            assert message.last_action == session.last_actions[robot]
            assert np.array_equal(np.asarray(message.features, np.float32), session.obs[robot])
            assert np.array_equal(message.available_actions, session.available[robot])
            assert len(data) == len(serialize_message(message))  # its padding is not defined
        session.advance(session.stay(), np.zeros(2, dtype=np.uint8))


@pytest.mark.parametrize("frame_id", ["", "m", "ma", "map", "base"])
def test_a_command_is_read_as_rclpy_writes_it(frame_id: str) -> None:
    message = Action(episode=2**32 - 1, step=70_000, action=-3, worst_action=4, fault=2)
    message.header.frame_id = frame_id
    data = serialize_message(message)
    read = command_from_bytes(data)
    assert (read.episode, read.step, read.action, read.fault) == (2**32 - 1, 70_000, -3, 2)
    with pytest.raises(UserError, match="cut short"):
        command_from_bytes(data[:20])
    with pytest.raises(UserError, match="0000 is not little-endian CDR"):
        command_from_bytes(b"\0\0" + data[2:])


def test_the_episodes_state_says_where_the_robots_are() -> None:
    env = make_env("coverage", 1)
    session = Session(env, 3, 0)
    writer = EpisodeWriter(env.spec, 3, Header())
    session.begin()
    seen = []
    for _ in range(3):
        message = deserialize_message(serialize_message(writer.fill(session)), EpisodeState)
        positions_m = np.asarray(message.positions_m, np.float32).reshape(-1, 2)
        assert np.array_equal(positions_m, env.positions_m[0])
        assert np.array_equal(np.asarray(message.state, np.float32), session.state)
        seen.append(positions_m)
        session.advance(np.array([1, 2, 3, 4], dtype=np.int32), np.zeros(4, dtype=np.uint8))
    assert not np.array_equal(seen[1], seen[2]), "nobody moved: the test is void"


def by_kind(picture: MarkerArray) -> dict[str, list[Marker]]:
    kinds: dict[str, list[Marker]] = {}
    for marker in picture.markers:
        kinds.setdefault(marker.ns, []).append(marker)
    return kinds


def test_markers_show_a_box_as_it_lies_and_a_round_goal() -> None:
    env = make_env("transport", 1)
    session = Session(env, 3, 0)
    session.begin()
    env.world.turns[0, 3, 0] = 0.5
    shown = by_kind(markers(session, Header(frame_id="map")))
    (box,), (goal,) = shown["things"], shown["sites"]
    assert box.type == Marker.CUBE
    assert (box.scale.x, box.scale.y) == (1.6, 1.6)
    assert [box.pose.position.x, box.pose.position.y] == env.world.bodies[0, 3, :2].tolist()
    turn = box.pose.orientation
    assert 2 * np.arctan2(turn.z, turn.w) == pytest.approx(0.5)
    assert (goal.type, goal.scale.x, goal.scale.y) == (Marker.CYLINDER, 1.0, 1.0)
    assert (goal.pose.position.x, goal.pose.position.y) == (11.5, 4.0)
    assert [robot.scale.x for robot in shown["robots"]] == [0.6] * 3
    assert len({(marker.ns, marker.id) for kind in shown.values() for marker in kind}) == 6


def test_markers_of_a_fight_lose_the_dead() -> None:
    env = make_env("skirmish/3m", 1)
    session = Session(env, 0, 0)
    session.begin()
    shown = by_kind(markers(session, Header()))
    assert [m.type for m in shown["opponents"]] == [Marker.CYLINDER] * 3
    assert {m.action for m in shown["robots"] + shown["opponents"]} == {Marker.ADD}
    while session.running:  # who stands still dies
        session.advance(session.stay(), np.array([1, 0, 0], dtype=np.uint8))
    shown = by_kind(markers(session, Header()))
    assert {m.action for m in shown["robots"]} == {Marker.DELETE}
    assert {m.action for m in shown["opponents"]} == {Marker.ADD}
