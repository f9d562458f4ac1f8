"""Messages to and from the core's types.

Commands stay in the form in which they travel: making Python message objects of them took more
than half of the gate's time. The layout is plain little-endian CDR (OMG DDS-RTPS 2.5, section 10;
XCDR version 1); a test holds it against rclpy's own serialization.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from builtin_interfaces.msg import Time
from crash_coach_interfaces.msg import Action, FaultEvent
from crash_coach_interfaces.msg import CrashPlan as CrashPlanMessage
from crash_coach_interfaces.msg import Fault as FaultMessage
from rclpy.serialization import deserialize_message
from std_msgs.msg import Header

from crash_coach_pkg.gate_state import Command, Decision, Event
from crash_coach_pkg.plan import CrashPlan, Fault, Mode, parse_mode
from sim_pkg.contract import UserError

# Encapsulation (4 bytes), stamp (8), length of frame_id (4), frame_id, padding to 4, fields.
_LITTLE_ENDIAN = b"\x00\x01"
_ENCAPSULATION_SIZE = 4
_FLAGS = struct.Struct("<???")  # terminated, truncated, success
_LENGTH = struct.Struct("<I")
_FRAME_ID_AT = 16
_COMMANDED = struct.Struct("<IIiB")  # episode, step, action, fault
_FAULT_AT = 12

MODE_TEXT = {Mode.NONE: "", Mode.MUTE: "mute", Mode.RANDOM: "random"}


def message_from_plan(
    plan: CrashPlan, robots: tuple[str, ...], lease_s: float, stamp: Time
) -> CrashPlanMessage:
    return CrashPlanMessage(
        header=Header(stamp=stamp),
        episode=plan.episode,
        revision=plan.revision,
        seed=plan.seed,
        rate=plan.rate,
        cap=plan.cap,
        lease_s=lease_s,
        faults=[
            FaultMessage(
                robot=robots[fault.robot],
                mode=MODE_TEXT[fault.mode],
                start_step=fault.start_step,
                duration_steps=fault.duration_steps,
            )
            for fault in plan.faults
        ],
    )


def plan_from_message(message: CrashPlanMessage, robots: tuple[str, ...]) -> CrashPlan:
    """Raises ValueError for an unknown robot or mode, or a lease that is not positive."""
    if not message.lease_s > 0:
        raise ValueError(f"lease_s {message.lease_s} is not positive")
    faults = []
    for fault in message.faults:
        if fault.robot not in robots:
            raise ValueError(f"unknown robot {fault.robot!r}; one of: {', '.join(robots)}")
        mode = parse_mode(fault.mode)
        faults.append(
            Fault(robots.index(fault.robot), mode, fault.start_step, fault.duration_steps)
        )
    return CrashPlan(
        message.episode, message.revision, message.seed, message.rate, message.cap, tuple(faults)
    )


def command_from_bytes(robot: int, data: bytes) -> Command:
    """A serialized Action, which is the token (and where its fields start).

    Raises:
        UserError: not little-endian CDR, or cut short.
    """
    start = _body(data)
    episode, step, action, _ = _COMMANDED.unpack_from(data, start)
    return Command(robot, episode, step, action, (data, start))


def _body(data: bytes) -> int:
    """Where an Action's fields start behind its header."""
    if data[:2] != _LITTLE_ENDIAN:
        raise UserError(f"command: encapsulation {data[:2].hex()} is not little-endian CDR")
    try:
        (length,) = _LENGTH.unpack_from(data, _FRAME_ID_AT - _LENGTH.size)
    except struct.error as error:
        raise UserError(f"command of {len(data)} bytes is cut short: {error}") from error
    start: int = _FRAME_ID_AT + (length + 3 & ~3)
    if len(data) < start + _COMMANDED.size:
        raise UserError(f"command of {len(data)} bytes is cut short")
    return start


def bytes_from_decision(decision: Decision) -> bytes:
    """What goes out on /<robot>/command: the bytes that came in, where nothing was replaced."""
    data: bytes
    data, start = decision.command.token
    if decision.mode == Mode.NONE and data[start + _FAULT_AT] == Mode.NONE:
        return data
    command = decision.command
    return data[:start] + _COMMANDED.pack(
        command.episode, command.step, decision.applied, decision.mode
    )


def effect_from_decision(decision: Decision, robots: tuple[str, ...]) -> FaultEvent:
    command = decision.command
    return FaultEvent(
        header=deserialize_message(command.token[0], Action).header,
        kind=FaultEvent.EFFECT,
        episode=command.episode,
        step=command.step,
        revision=decision.revision,
        robot=robots[command.robot],
        mode=MODE_TEXT[decision.mode],
        intent=command.action,
        applied=decision.applied,
    )


@dataclass(frozen=True, slots=True)
class Played:
    """What the coach reads of an EpisodeState."""

    episode: int
    ended: bool
    success: bool


def played_from_bytes(data: bytes) -> Played:
    """A serialized EpisodeState, of which one arrives per control step.

    Raises:
        UserError: not little-endian CDR, or cut short.
    """
    if data[:2] != _LITTLE_ENDIAN:
        raise UserError(f"episode: encapsulation {data[:2].hex()} is not little-endian CDR")
    try:
        (length,) = _LENGTH.unpack_from(data, _FRAME_ID_AT - _LENGTH.size)
        start = _FRAME_ID_AT + (length + 3 & ~3)
        (episode,) = _LENGTH.unpack_from(data, start)
        count_at = _align_8(start + 8) + 8  # behind episode, step and seed
        (count,) = _LENGTH.unpack_from(data, count_at)
        flags_at = _align_8(count_at + 4 + 4 * count) + 16  # behind state, reward, return
        terminated, truncated, success = _FLAGS.unpack_from(data, flags_at)
    except struct.error as error:
        raise UserError(f"episode of {len(data)} bytes is cut short: {error}") from error
    return Played(episode, terminated or truncated, success)


def _align_8(offset: int) -> int:
    """CDR aligns from behind the encapsulation."""
    return (offset - _ENCAPSULATION_SIZE + 7 & ~7) + _ENCAPSULATION_SIZE


def message_from_event(event: Event, stamp: Time) -> FaultEvent:
    return FaultEvent(
        header=Header(stamp=stamp),
        kind=int(event.kind),
        episode=event.episode,
        step=event.step,
        revision=event.revision,
        intent=-1,
        applied=-1,
    )
