"""What gate and coach read and write in serialized form, against rclpy's own serialization."""

from __future__ import annotations

import math
from array import array
from dataclasses import replace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from crash_coach_interfaces.msg import Action, EpisodeState, FaultEvent, Observation
from crash_coach_interfaces.msg import CrashPlan as PlanMessage
from rclpy.serialization import deserialize_message, serialize_message

from crash_coach_common.contract import UserError
from crash_coach_pkg.faults import mode_code, mode_names
from crash_coach_pkg.gate.messages import Decision, Seen
from crash_coach_pkg.gate.plan_book import Event, EventKind
from crash_coach_pkg.plan import NEXT_STEP, CrashPlan, Fault, Trigger, TriggerKind
from crash_coach_pkg.ros.convert import (
    Played,
    bytes_from_decision,
    bytes_from_seen,
    command_from_bytes,
    effect_from_decision,
    message_from_event,
    message_from_plan,
    plan_from_message,
    played_from_bytes,
    sight_from_bytes,
    world_from_message,
)


def command(frame_id: str, fault: int = 0) -> Action:
    message = Action(episode=2**32 - 1, step=70_000, action=-3, worst_action=7, fault=fault)
    message.header.stamp.sec, message.header.stamp.nanosec = -5, 999_999_999
    message.header.frame_id = frame_id
    return message


@pytest.mark.parametrize("frame_id", ["", "m", "ma", "map", "base"])
def test_an_untouched_command_goes_out_as_it_came_in(frame_id: str) -> None:
    data = serialize_message(command(frame_id))
    read = command_from_bytes(1, data)
    assert read[:5] == (1, 2**32 - 1, 70_000, -3, 7)
    assert bytes_from_decision(Decision(read, "", 0, -3, 1)) is data


@pytest.mark.parametrize("frame_id", ["", "m", "ma", "map", "base"])
def test_a_replaced_command_differs_in_action_and_fault_only(frame_id: str) -> None:
    read = command_from_bytes(0, serialize_message(command(frame_id)))
    for mode in mode_names():
        out = deserialize_message(bytes_from_decision(Decision(read, mode, 0, 4, 1)), Action)
        expected = command(frame_id, mode_code(mode))
        expected.action = 4
        assert out == expected


def test_a_policy_cannot_claim_a_fault() -> None:
    read = command_from_bytes(0, serialize_message(command("map", Action.FAULT_MUTE)))
    out = deserialize_message(bytes_from_decision(Decision(read, "", 0, -3, 1)), Action)
    assert out == command("map")


@pytest.mark.parametrize("frame_id", ["", "m", "map", "grün"])
def test_the_effect_carries_the_commands_header(frame_id: str) -> None:
    read = command_from_bytes(1, serialize_message(command(frame_id)))
    event = effect_from_decision(Decision(read, "mute", 4, -1, 9), ("a", "b"))
    assert event.header == command(frame_id).header
    assert (event.kind, event.robot, event.mode) == (FaultEvent.EFFECT, "b", "mute")
    assert (event.intent, event.applied, event.revision, event.entry) == (-3, -1, 9, 4)


def test_other_bytes_are_refused() -> None:
    data = serialize_message(command("map"))
    with pytest.raises(UserError, match="0000 is not little-endian CDR"):
        command_from_bytes(0, b"\0\0" + data[2:])
    for size in (8, 20, 30):
        with pytest.raises(UserError, match=f"command of {size} bytes is cut short"):
            command_from_bytes(0, data[:size])
    with pytest.raises(UserError, match="command of step 4294967295"):
        command_from_bytes(0, serialize_message(Action(step=NEXT_STEP)))
    with pytest.raises(UserError, match="observation of step 4294967295"):
        sight_from_bytes(0, serialize_message(Observation(step=NEXT_STEP)))


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


PLAN = CrashPlan(
    episode=2**32 - 1,
    revision=3,
    seed=2**64 - 1,
    rate=0.3,
    cap=2,
    faults=(
        Fault(0, "mute"),
        Fault(1, "delay", NEXT_STEP, 7, (("steps", 2.0),), entry=3),
        Fault(0, "drop", 4, 0, (("probability", 0.1), ("to_bad", 0.2)), entry=1),
        Fault(1, "blind", 0, 1, (), Trigger(TriggerKind.HAZARD, (0.25,))),
        Fault(1, "noise", 0, 1, (), Trigger(TriggerKind.NEAR, (1.5, -2.0, 0.75))),
        Fault(0, "freeze", 9, 1, (), Trigger(TriggerKind.RETURN_ABOVE, (-3.5,))),
    ),
)
TEAM = ("a", "b")


def test_a_plan_comes_back_as_it_was_sent() -> None:
    sent = message_from_plan(PLAN, TEAM, 1.5, Time(sec=1))
    message = deserialize_message(serialize_message(sent), PlanMessage)
    assert message.lease_s == 1.5
    assert plan_from_message(message, TEAM) == PLAN


def test_synonyms_have_one_name_behind_the_wire() -> None:
    message = message_from_plan(PLAN, TEAM, 1.0, Time())
    message.faults[0].mode = "stay"
    assert plan_from_message(message, TEAM).faults[0].mode == "mute"


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("robot", "c", "unknown robot 'c'; one of: a, b"),
        ("mode", "explode", "unknown crash mode 'explode'"),
        ("parameter_names", ["x", "y"], "2 parameter names, but 1 values"),
        ("parameter_values", [math.nan], "nan of fault delay on b is not a number"),
        ("trigger", 9, "9 is not a valid TriggerKind"),
        ("trigger_values", [1.0], "trigger STEP has 1 values, not 0"),
    ],
)
def test_what_no_gate_can_carry_out_is_refused(field: str, value: object, reason: str) -> None:
    message = message_from_plan(PLAN, TEAM, 1.0, Time())
    setattr(message.faults[1], field, value)
    with pytest.raises(UserError, match=reason):
        plan_from_message(message, TEAM)


@pytest.mark.parametrize("rate", [-0.1, 1.5, math.nan])
def test_a_rate_that_no_coach_could_go_on_from_is_refused(rate: float) -> None:
    message = message_from_plan(replace(PLAN, rate=rate), TEAM, 1.0, Time())
    with pytest.raises(UserError, match=r"rate .* is not in \[0, 1\]"):
        plan_from_message(message, TEAM)


@pytest.mark.parametrize("lease_s", [0.0, -1.0, math.nan, math.inf])
def test_a_lease_that_never_ends_is_refused(lease_s: float) -> None:
    message = message_from_plan(PLAN, TEAM, lease_s, Time())
    with pytest.raises(UserError, match="is not a positive number of seconds"):
        plan_from_message(message, TEAM)


def test_events_say_whom_and_what_they_concern() -> None:
    event = Event(EventKind.ACTIVE, 4, 5, 6, 1, "delay", 2)
    message = message_from_event(event, TEAM, Time(sec=9))
    assert (message.kind, message.episode, message.step) == (FaultEvent.ACTIVE, 4, 5)
    assert (message.revision, message.robot, message.mode, message.entry) == (6, "b", "delay", 2)
    assert (message.intent, message.applied) == (-1, -1)
    event = Event(EventKind.REFUSED, 4, 5, 6, detail="why")
    message = message_from_event(event, TEAM, Time())
    assert (message.robot, message.detail) == ("", "why")
    assert {kind.name: kind.value for kind in EventKind} == {
        kind.name: getattr(FaultEvent, kind.name) for kind in EventKind
    }


def observation(frame_id: str, features: int, actions: int) -> Observation:
    message = Observation(episode=2**32 - 1, step=70_000, last_action=-1)
    message.header.stamp.sec, message.header.stamp.nanosec = -5, 999_999_999
    message.header.frame_id = frame_id
    message.features = array("f", np.linspace(-1, 1, features).astype(np.float32))
    message.available_actions = array("B", [i % 2 for i in range(actions)])
    return message


@pytest.mark.parametrize("frame_id", ["", "m", "ma", "map", "base"])
@pytest.mark.parametrize(("features", "actions"), [(0, 0), (1, 1), (5, 3), (8, 4)])
def test_an_observation_is_read_and_relayed(frame_id: str, features: int, actions: int) -> None:
    message = observation(frame_id, features, actions)
    data = serialize_message(message)
    sight = sight_from_bytes(1, data)
    assert (sight.robot, *sight.key) == (1, 2**32 - 1, 70_000)
    assert sight.features.tolist() == list(message.features)
    assert sight.available.tolist() == [bool(a) for a in message.available_actions]
    assert bytes_from_seen(Seen(sight, None)) is data
    other = np.arange(features, dtype=np.float32)
    relayed = deserialize_message(bytes_from_seen(Seen(sight, other)), Observation)
    assert list(relayed.features) == other.tolist()
    relayed.features = message.features
    assert relayed == message


def test_observations_that_are_cut_short_are_refused() -> None:
    data = serialize_message(observation("map", 5, 3))
    for size in (8, 20, 40, 56):
        with pytest.raises(UserError, match=f"observation of {size} bytes is cut short"):
            sight_from_bytes(0, data[:size])
    with pytest.raises(UserError, match="0000 is not little-endian CDR"):
        sight_from_bytes(0, b"\0\0" + data[2:])


def test_conditions_see_positions_as_they_travel() -> None:
    message = EpisodeState(episode_return=-1.25)
    message.positions_m = array("f", [0.1, 2.0, -3.5, 4.0])
    message = deserialize_message(serialize_message(message), EpisodeState)
    with pytest.raises(UserError, match="4 coordinates, not 2 for each of 3 robots"):
        world_from_message(message, 3)
    world = world_from_message(message, 2)
    assert world.episode_return == -1.25
    assert world.positions_m.dtype == np.float32
    assert world.positions_m.tolist() == np.array([[0.1, 2], [-3.5, 4]], np.float32).tolist()
