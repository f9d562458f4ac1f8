"""Messages of several robots as one, against rclpy's own serialization."""

from __future__ import annotations

from array import array

import pytest
from crash_coach_interfaces.msg import Action, Observation, TeamAction, TeamObservation
from rclpy.serialization import deserialize_message, serialize_message

from crash_coach_common.contract import UserError
from crash_coach_common.ros.team_topics import COMMANDS, OBSERVATIONS
from crash_coach_common.team_cdr import RobotMessage

ROBOTS = ("a", "rover", "robot_3", "grün")
FRAMES = ("", "m", "map", "base")


def action(robot: int) -> Action:
    message = Action(episode=2**32 - 1, step=robot, action=-robot, worst_action=7, fault=robot)
    message.header.stamp.sec, message.header.frame_id = -5, FRAMES[robot]
    return message


def observation(robot: int) -> Observation:
    message = Observation(episode=3, step=robot, last_action=-1)
    message.header.stamp.nanosec, message.header.frame_id = 999_999_999, FRAMES[robot]
    message.features = array("f", [0.5, 1e-30, -2.0][:robot])
    message.available_actions = array("B", [1, 0, 1, 1, 0][: robot + 1])
    return message


def serialized(robots: list[int], make: object) -> list[RobotMessage]:
    assert callable(make)
    return [(robot, bytes(serialize_message(make(robot)))) for robot in robots]


@pytest.mark.parametrize("robots", [[0, 1, 2, 3], [3, 1], [2], []])
def test_what_is_joined_is_what_rclpy_reads(robots: list[int]) -> None:
    names = [ROBOTS[robot] for robot in robots]
    joined = COMMANDS.codec(ROBOTS).join(serialized(robots, action))
    commands = deserialize_message(joined, TeamAction)
    assert (commands.robots, commands.commands) == (names, [action(robot) for robot in robots])
    joined = OBSERVATIONS.codec(ROBOTS).join(serialized(robots, observation))
    seen = deserialize_message(joined, TeamObservation)
    assert (seen.robots, seen.observations) == (names, [observation(robot) for robot in robots])


@pytest.mark.parametrize("robots", [[0, 1, 2, 3], [3, 1], [2], []])
def test_what_rclpy_writes_is_split(robots: list[int]) -> None:
    names = [ROBOTS[robot] for robot in robots]
    codec = COMMANDS.codec(ROBOTS)
    message = TeamAction(robots=names, commands=[action(robot) for robot in robots])
    for _ in range(2):  # names are read once, then recognised
        found = codec.split(bytes(serialize_message(message)))
        assert [(robot, deserialize_message(data, Action)) for robot, data in found] == [
            (robot, action(robot)) for robot in robots
        ]
    seen = TeamObservation(robots=names, observations=[observation(robot) for robot in robots])
    split = OBSERVATIONS.codec(ROBOTS).split(bytes(serialize_message(seen)))
    assert [(robot, deserialize_message(data, Observation)) for robot, data in split] == [
        (robot, observation(robot)) for robot in robots
    ]


def test_others_robots_are_left_out() -> None:
    joined = OBSERVATIONS.codec(ROBOTS).join(serialized([0, 1, 2, 3], observation))
    (only,) = OBSERVATIONS.codec(("robot_3", "stranger")).split(joined)
    assert (only[0], deserialize_message(only[1], Observation)) == (0, observation(2))


def test_only_what_stands_up_to_the_last_of_ours_is_read() -> None:
    joined = OBSERVATIONS.codec(ROBOTS).join(serialized([0, 1, 2, 3], observation))
    upto = OBSERVATIONS.codec(ROBOTS).join(serialized([0, 1, 2], observation))
    behind = len(joined) - len(upto)
    for reader in (OBSERVATIONS.codec(("rover", "robot_3")), OBSERVATIONS.codec(("robot_3",))):
        whole = reader.split(joined)
        assert [robot for robot, _ in whole] == list(range(len(whole)))
        assert reader.split(joined[: len(joined) - behind // 2]) == whole
        with pytest.raises(UserError, match="is cut short"):
            reader.split(joined[: len(joined) - behind - 8])


def test_lengths_may_change_from_message_to_message() -> None:
    """What is remembered of one message is not read into the next."""
    reader = OBSERVATIONS.codec(("robot_3", "a"))
    for changed in ("frame", "features", "actions", "none", "cut"):
        messages = [observation(robot) for robot in (0, 1, 2)]
        if changed == "frame":
            messages[1].header.frame_id = "a longer one"
        elif changed == "features":
            messages[1].features = array("f", [0.25] * 7)
        elif changed == "actions":
            messages[0].available_actions = array("B", [1] * 9)
        seen = TeamObservation(robots=list(ROBOTS[:3]), observations=messages)
        data = bytes(serialize_message(seen))
        if changed == "cut":
            with pytest.raises(UserError, match="is cut short"):
                reader.split(data[:-8])
            continue
        for _ in range(2):
            assert {
                robot: deserialize_message(it, Observation) for robot, it in reader.split(data)
            } == {
                0: messages[2],
                1: messages[0],
            }


def test_other_bytes_are_refused() -> None:
    codec = COMMANDS.codec(ROBOTS)
    joined = codec.join(serialized([0, 1, 2], action))
    with pytest.raises(UserError, match=r"team's commands: encapsulation 0000 is not"):
        codec.split(b"\0\0" + joined[2:])
    assert len(codec.split(joined)) == 3
    for size in (5, 9, 40, 70, len(joined) - 1 - (-len(joined) & 3) - 3):
        for reader in (codec, COMMANDS.codec(ROBOTS)):  # that knows the names, and that does not
            with pytest.raises(UserError, match=r"is cut short|messages for"):
                reader.split(joined[:size])
    fewer = TeamAction(robots=["a", "rover"], commands=[action(0)])
    with pytest.raises(UserError, match="1 messages for 2 robots"):
        codec.split(bytes(serialize_message(fewer)))
