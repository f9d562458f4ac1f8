"""The sim's serialized observations and commands, against rclpy's own serialization."""

from __future__ import annotations

import numpy as np
import pytest
from crash_coach_interfaces.msg import Action, Observation
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header

from sim_pkg.contract import UserError
from sim_pkg.env import make_env
from sim_pkg.ros.convert import ObservationWriter, command_from_bytes, set_time
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
    message = Action(episode=2**32 - 1, step=70_000, action=-3, fault=2)
    message.header.frame_id = frame_id
    data = serialize_message(message)
    read = command_from_bytes(data)
    assert (read.episode, read.step, read.action, read.fault) == (2**32 - 1, 70_000, -3, 2)
    with pytest.raises(UserError, match="cut short"):
        command_from_bytes(data[:20])
    with pytest.raises(UserError, match="0000 is not little-endian CDR"):
        command_from_bytes(b"\0\0" + data[2:])
