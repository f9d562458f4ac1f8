"""Messages to what the console's core works with."""

from __future__ import annotations

import math
from typing import Any

from builtin_interfaces.msg import Time
from crash_coach_interfaces.msg import Arena as ArenaMessage
from crash_coach_interfaces.msg import ArenaState, CrashPlan, FaultEvent
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Quaternion
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rclpy.parameter import Parameter, parameter_value_to_python

from crash_coach_common import cdr
from crash_coach_common.contract import UserError
from crash_coach_console.arena import Arena, State, pairs
from crash_coach_console.team import Plan, PlannedFault
from crash_coach_pkg.coach.parameters import Value
from crash_coach_pkg.plan import NEXT_STEP, TriggerKind

KINDS = {
    FaultEvent.ARMED: "armed",
    FaultEvent.EFFECT: "effect",
    FaultEvent.CLEARED: "cleared",
    FaultEvent.EXPIRED: "expired",
    FaultEvent.ACTIVE: "active",
    FaultEvent.REFUSED: "refused",
    FaultEvent.INTRUDER: "intruder",
}
_SIDES = {
    ArenaMessage.ROBOTS: "robots",
    ArenaMessage.OPPONENTS: "opponents",
    ArenaMessage.THINGS: "things",
}
_NS = 1e-9


def arena_from_message(message: ArenaMessage) -> Arena:
    """Raises UserError where its lists do not fit each other."""
    n = len(message.actors)
    sizes = pairs(message.sizes_m)
    lists = {
        "kinds": len(message.kinds),
        "sides": len(message.sides),
        "radii_m": len(message.radii_m),
        "sizes_m": len(sizes),
    }
    for name, length in lists.items():
        if length != n:
            raise UserError(f"arena: {length} {name} for {n} actors")
    return Arena(
        scenario=message.scenario,
        lockstep=message.lockstep,
        dt_s=message.dt_s,
        action_names=tuple(message.action_names),
        arena_m=(float(message.arena_m[0]), float(message.arena_m[1])),
        walled_m=tuple(map(float, message.walled_m)),
        cell_m=float(message.cell_m),
        site_name=message.site_name,
        site_radius_m=float(message.site_radius_m),
        sites_m=tuple(map(tuple, pairs(message.sites_m))),
        rough_m=tuple(map(tuple, pairs(message.rough_m, 4))),
        actors=tuple(
            (name, kind, _SIDES.get(side, "things"), float(radius), tuple(size))
            for name, kind, side, radius, size in zip(
                message.actors, message.kinds, message.sides, message.radii_m, sizes, strict=True
            )
        ),
    )


def state_from_message(message: ArenaState) -> State:
    return State(
        episode=message.episode,
        step=message.step,
        time_s=seconds(message.header.stamp),
        episode_return=message.episode_return,
        ended=message.ended,
        success=message.success,
        poses=tuple(message.poses),
        health=tuple(message.health),
        shield=tuple(message.shield),
        sites_done=tuple(message.sites_done),
        crashed=tuple(message.crashed),
        hits=tuple(message.hits),
    )


def seconds(stamp: Time) -> float:
    return float(stamp.sec + stamp.nanosec * _NS)


def yaw_rad(orientation: Quaternion) -> float:
    """The turn about the vertical."""
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def plan_from_message(message: CrashPlan) -> Plan:
    """For show: what no gate could carry out is shown as it is."""
    triggers = {int(kind): kind.name.lower() for kind in TriggerKind}
    return Plan(
        message.episode,
        message.revision,
        message.rate,
        tuple(
            PlannedFault(
                fault.robot,
                fault.mode,
                fault.start_step,
                fault.duration_steps,
                dict(zip(fault.parameter_names, fault.parameter_values, strict=False)),
                triggers.get(fault.trigger, str(fault.trigger)),
            )
            for fault in message.faults
        ),
    )


def event_kind(data: bytes) -> int:
    """Of a serialized FaultEvent, without reading the rest: there may be hundreds a second.

    -1: it is not little-endian CDR, or cut short.
    """
    if data[:2] != cdr.LITTLE_ENDIAN or len(data) < cdr.FRAME_ID_AT:
        return -1
    (length,) = cdr.COUNT.unpack_from(data, cdr.FRAME_ID_AT - cdr.COUNT.size)
    at = cdr.FRAME_ID_AT + length  # a byte needs no padding
    return data[at] if at < len(data) else -1


def event_value(message: FaultEvent) -> dict[str, Any]:
    """JSON values of an event for the page's log."""
    return {
        "kind": KINDS.get(message.kind, str(message.kind)),
        "episode": message.episode,
        "step": None if message.step == NEXT_STEP else message.step,
        "revision": message.revision,
        "robot": message.robot,
        "mode": message.mode,
        "detail": message.detail,
    }


def diagnosis(status: DiagnosticStatus) -> tuple[str, str, str, str, str | None] | None:
    """(who, robot, state, words, mode) of a line of ours on /diagnostics; None: somebody else's."""
    who, colon, robot = status.name.partition(": ")
    if not colon or who not in ("sim", "gate"):
        return None
    values = {pair.key: pair.value for pair in status.values}
    return who, robot, values.get("state", ""), status.message, values.get("mode")


def value_from_message(message: ParameterValue) -> Value | None:
    """None: not set."""
    value = parameter_value_to_python(message)
    return value if value is None or isinstance(value, bool | int | float | str) else tuple(value)


def parameter_message(name: str, value: Value) -> ParameterMessage:
    plain = list(value) if isinstance(value, tuple) else value
    made: ParameterMessage = Parameter(name, value=plain).to_parameter_msg()
    return made
