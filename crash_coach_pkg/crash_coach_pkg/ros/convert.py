"""Messages to and from the core's types.

Commands and observations stay in the form in which they travel: making Python message objects of
them took more than half of the gate's time; see crash_coach_common.cdr.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np
from builtin_interfaces.msg import Time
from crash_coach_interfaces.msg import CrashPlan as CrashPlanMessage
from crash_coach_interfaces.msg import EpisodeState, FaultEvent
from crash_coach_interfaces.msg import Fault as FaultMessage
from std_msgs.msg import Header

from crash_coach_common.cdr import (
    COMMANDED,
    COUNT,
    ENCAPSULATION_SIZE,
    FRAME_ID_AT,
    OBSERVED,
    body_at,
    cut_short,
)
from crash_coach_common.contract import UserError
from crash_coach_pkg.effects import NO_ACTION
from crash_coach_pkg.faults import fault_mode, mode_code
from crash_coach_pkg.gate.messages import Command, Decision, Seen, Sight
from crash_coach_pkg.gate.plan_book import TEAM, Event
from crash_coach_pkg.plan import NEXT_STEP, CrashPlan, Fault, Trigger, TriggerKind
from crash_coach_pkg.schedule import World

_FLAGS = struct.Struct("<???")  # terminated, truncated, success
_STAMP = struct.Struct("<iI")
_FAULT_AT = 16


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
                mode=fault.mode,
                start_step=fault.start_step,
                duration_steps=fault.duration_steps,
                parameter_names=[name for name, _ in fault.parameters],
                parameter_values=[float(value) for _, value in fault.parameters],
                trigger=int(fault.trigger.kind),
                trigger_values=list(fault.trigger.values),
                entry=fault.entry,
            )
            for fault in plan.faults
        ],
    )


def plan_from_message(message: CrashPlanMessage, robots: tuple[str, ...]) -> CrashPlan:
    """Raises UserError for what no gate could carry out: an unknown robot or mode, a trigger or
    parameters that are malformed, a lease that is not positive, a rate outside [0, 1]."""
    if not 0 < message.lease_s < math.inf:
        raise UserError(f"lease_s {message.lease_s} is not a positive number of seconds")
    if not 0 <= message.rate <= 1:
        raise UserError(f"rate {message.rate} is not in [0, 1]")
    return CrashPlan(
        message.episode,
        message.revision,
        message.seed,
        message.rate,
        message.cap,
        tuple(_fault(fault, robots) for fault in message.faults),
    )


def _fault(message: FaultMessage, robots: tuple[str, ...]) -> Fault:
    if message.robot not in robots:
        raise UserError(f"unknown robot {message.robot!r}; one of: {', '.join(robots)}")
    names, values = message.parameter_names, message.parameter_values
    if len(names) != len(values):
        raise UserError(f"{len(names)} parameter names, but {len(values)} values")
    for value in (*values, *message.trigger_values):
        if not math.isfinite(value):
            raise UserError(f"{value} of fault {message.mode} on {message.robot} is not a number")
    try:
        trigger = Trigger(TriggerKind(message.trigger), tuple(message.trigger_values))
    except ValueError as error:
        raise UserError(f"fault {message.mode} on {message.robot}: {error}") from error
    return Fault(
        robot=robots.index(message.robot),
        mode=fault_mode(message.mode).name,
        start_step=message.start_step,
        duration_steps=message.duration_steps,
        parameters=tuple(zip(names, values, strict=True)),
        trigger=trigger,
        entry=message.entry,
    )


def command_from_bytes(robot: int, data: bytes) -> Command:
    """A serialized Action, which is the token (and where its fields start).

    Raises:
        UserError: not little-endian CDR, cut short, or of a step that is no step.
    """
    start = body_at("command", data)
    if len(data) < start + COMMANDED.size:
        raise UserError(f"command of {len(data)} bytes is cut short")
    episode, step, action, worst, _ = COMMANDED.unpack_from(data, start)
    if step == NEXT_STEP:  # the step after it would not fit the messages
        raise UserError(f"command of step {step}: steps are below {NEXT_STEP}")
    return Command(robot, episode, step, action, worst, (data, start))


def bytes_from_decision(decision: Decision) -> bytes:
    """What goes out on /<robot>/command: the bytes that came in, where nothing was replaced."""
    data: bytes
    data, start = decision.command.token
    if not decision.mode and data[start + _FAULT_AT] == 0:
        return data
    command = decision.command
    return data[:start] + COMMANDED.pack(
        command.episode, command.step, decision.applied, command.worst, mode_code(decision.mode)
    )


def effect_from_decision(decision: Decision, robots: tuple[str, ...]) -> FaultEvent:
    command = decision.command
    data: bytes
    data, _ = command.token
    sec, nanosec = _STAMP.unpack_from(data, ENCAPSULATION_SIZE)
    (length,) = COUNT.unpack_from(data, FRAME_ID_AT - COUNT.size)
    frame_id = data[FRAME_ID_AT : FRAME_ID_AT + length].rstrip(b"\0").decode()
    return FaultEvent(
        header=Header(stamp=Time(sec=sec, nanosec=nanosec), frame_id=frame_id),
        kind=FaultEvent.EFFECT,
        episode=command.episode,
        step=command.step,
        revision=decision.revision,
        robot=robots[command.robot],
        mode=decision.mode,
        entry=decision.entry,
        intent=command.action,
        applied=decision.applied,
    )


def sight_from_bytes(robot: int, data: bytes) -> Sight:
    """A serialized Observation, which is the token (and where its features start).

    Raises:
        UserError: not little-endian CDR, cut short, or of a step that is no step.
    """
    start = body_at("observation", data)
    try:
        episode, step, _ = OBSERVED.unpack_from(data, start)
        (count,) = COUNT.unpack_from(data, start + OBSERVED.size)
        features_at = start + OBSERVED.size + COUNT.size
        features = np.frombuffer(data, np.float32, count, features_at)
        (n_actions,) = COUNT.unpack_from(data, features_at + 4 * count)
        available_at = features_at + 4 * count + COUNT.size
        available = np.frombuffer(data, np.uint8, n_actions, available_at) != 0
    except (struct.error, ValueError) as error:
        raise cut_short("observation", data, error) from error
    if step == NEXT_STEP:
        raise UserError(f"observation of step {step}: steps are below {NEXT_STEP}")
    return Sight(robot, episode, step, features, available, (data, features_at))


def bytes_from_seen(seen: Seen) -> bytes:
    """What goes out on /<robot>/observation_seen: the bytes that came in, where none changed."""
    data: bytes
    data, features_at = seen.sight.token
    if seen.features is None:
        return data
    features = np.ascontiguousarray(seen.features, dtype=np.float32).tobytes()
    return data[:features_at] + features + data[features_at + len(features) :]


def world_from_message(message: EpisodeState, n_robots: int) -> World:
    """Raises UserError where it is of another team."""
    if len(message.positions_m) != 2 * n_robots:
        raise UserError(
            f"/sim/episode has {len(message.positions_m)} coordinates, not 2 for each of "
            f"{n_robots} robots"
        )
    positions_m = np.array(message.positions_m, dtype=np.float32).reshape(-1, 2)
    return World(positions_m, message.episode_return)


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
    start = body_at("episode", data)
    try:
        (episode,) = COUNT.unpack_from(data, start)
        count_at = _align_8(start + 8) + 8  # behind episode, step and seed
        (count,) = COUNT.unpack_from(data, count_at)
        flags_at = _align_8(count_at + 4 + 4 * count) + 16  # behind state, reward, return
        terminated, truncated, success = _FLAGS.unpack_from(data, flags_at)
    except struct.error as error:
        raise cut_short("episode", data, error) from error
    return Played(episode, terminated or truncated, success)


def _align_8(offset: int) -> int:
    """CDR aligns from behind the encapsulation."""
    return (offset - ENCAPSULATION_SIZE + 7 & ~7) + ENCAPSULATION_SIZE


def message_from_event(event: Event, robots: tuple[str, ...], stamp: Time) -> FaultEvent:
    return FaultEvent(
        header=Header(stamp=stamp),
        kind=int(event.kind),
        episode=event.episode,
        step=event.step,
        revision=event.revision,
        robot="" if event.robot == TEAM else robots[event.robot],
        mode=event.mode,
        entry=event.entry,
        intent=NO_ACTION,
        applied=event.applied,
        detail=event.detail,
    )
