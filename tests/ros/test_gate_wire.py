"""What gate and coach read and write in serialized form, against rclpy's own serialization."""

from __future__ import annotations

from array import array

import pytest
from crash_coach_interfaces.msg import Action, EpisodeState, FaultEvent
from rclpy.serialization import deserialize_message, serialize_message

from crash_coach_pkg.gate_state import Decision
from crash_coach_pkg.plan import Mode
from crash_coach_pkg.ros.convert import (
    Played,
    bytes_from_decision,
    command_from_bytes,
    effect_from_decision,
    played_from_bytes,
)
from sim_pkg.contract import UserError


def command(frame_id: str, fault: int = 0) -> Action:
    message = Action(episode=2**32 - 1, step=70_000, action=-3, fault=fault)
    message.header.stamp.sec, message.header.stamp.nanosec = -5, 999_999_999
    message.header.frame_id = frame_id
    return message


@pytest.mark.parametrize("frame_id", ["", "m", "ma", "map", "base"])
def test_an_untouched_command_goes_out_as_it_came_in(frame_id: str) -> None:
    data = serialize_message(command(frame_id))
    read = command_from_bytes(1, data)
    assert (read.robot, read.episode, read.step, read.action) == (1, 2**32 - 1, 70_000, -3)
    assert bytes_from_decision(Decision(read, Mode.NONE, -3, 1)) is data


@pytest.mark.parametrize("frame_id", ["", "m", "ma", "map", "base"])
def test_a_replaced_command_differs_in_action_and_fault_only(frame_id: str) -> None:
    read = command_from_bytes(0, serialize_message(command(frame_id)))
    out = deserialize_message(bytes_from_decision(Decision(read, Mode.RANDOM, 4, 1)), Action)
    expected = command(frame_id, Action.FAULT_RANDOM)
    expected.action = 4
    assert out == expected


def test_a_policy_cannot_claim_a_fault() -> None:
    read = command_from_bytes(0, serialize_message(command("map", Action.FAULT_MUTE)))
    out = deserialize_message(bytes_from_decision(Decision(read, Mode.NONE, -3, 1)), Action)
    assert out == command("map")


def test_the_effect_carries_the_commands_header() -> None:
    read = command_from_bytes(1, serialize_message(command("map")))
    event = effect_from_decision(Decision(read, Mode.MUTE, -1, 9), ("a", "b"))
    assert event.header == command("map").header
    assert (event.kind, event.robot, event.mode) == (FaultEvent.EFFECT, "b", "mute")
    assert (event.intent, event.applied, event.revision) == (-3, -1, 9)


def test_other_bytes_are_refused() -> None:
    data = serialize_message(command("map"))
    with pytest.raises(UserError, match="0000 is not little-endian CDR"):
        command_from_bytes(0, b"\0\0" + data[2:])
    for size in (8, 20, 30):
        with pytest.raises(UserError, match=f"command of {size} bytes is cut short"):
            command_from_bytes(0, data[:size])


@pytest.mark.parametrize("frame_id", ["", "m", "ma", "map", "base", "odom_1"])
@pytest.mark.parametrize("state_size", [0, 1, 2, 3, 8])
def test_the_end_of_an_episode_is_read(frame_id: str, state_size: int) -> None:
    for ended, success in (("terminated", True), ("truncated", False), ("", False)):
        message = EpisodeState(episode=2**32 - 2, step=5, seed=2**64 - 1, reward=-1.0)
        message.header.frame_id = frame_id
        message.state = array("f", [0.5] * state_size)
        message.success = success
        if ended:
            setattr(message, ended, True)
        data = serialize_message(message)
        assert played_from_bytes(data) == Played(2**32 - 2, bool(ended), success)
        with pytest.raises(UserError, match="cut short"):
            played_from_bytes(data[:40])
        with pytest.raises(UserError, match="0000 is not little-endian CDR"):
            played_from_bytes(b"\0\0" + data[2:])
