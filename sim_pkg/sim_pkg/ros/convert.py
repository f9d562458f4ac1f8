"""Core types to messages: no Node, no publishing.

Observations and commands, of which there is one per robot and step, stay in the form in which they
travel: Python message objects took more than half of a step's time; see crash_coach_common.cdr.
Other message objects are made once, and what changes in every step is written through numpy views
of their arrays.
"""

from __future__ import annotations

import math
import struct
from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from builtin_interfaces.msg import Time
from crash_coach_interfaces.msg import EpisodeState, FaultEvent
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point
from nav_msgs.msg import Odometry
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from crash_coach_common.cdr import COMMANDED, COUNT, LITTLE_ENDIAN, OBSERVED, body_at, cut_short
from crash_coach_common.contract import EnvSpec
from sim_pkg.lockstep import Decisions, Health
from sim_pkg.realtime import NewestCommands
from sim_pkg.render.frames import Side, actors, vitals
from sim_pkg.scenarios.base import Scene
from sim_pkg.session import Session

MAP_FRAME = "map"
_HEAD = struct.Struct("<4siII")  # encapsulation, stamp, length of frame_id
_NS_PER_S = 1_000_000_000
_RED = ColorRGBA(r=0.85, g=0.15, b=0.15, a=1.0)
_BLUE = ColorRGBA(r=0.2, g=0.4, b=0.85, a=1.0)
_YELLOW = ColorRGBA(r=0.95, g=0.75, b=0.1, a=1.0)
_GREEN = ColorRGBA(r=0.2, g=0.7, b=0.3, a=1.0)
_GREY = ColorRGBA(r=0.5, g=0.5, b=0.5, a=1.0)
_COLOURS = {
    Side.ROBOTS: _BLUE,
    Side.OPPONENTS: ColorRGBA(r=0.85, g=0.5, b=0.1, a=1.0),
    Side.THINGS: ColorRGBA(r=0.55, g=0.42, b=0.27, a=1.0),
}
_BODY_HEIGHT_M, _SITE_HEIGHT_M = 0.3, 0.02
_LEVELS = {
    Health.OK: DiagnosticStatus.OK,
    Health.FAULTED: DiagnosticStatus.WARN,
    Health.MUTED: DiagnosticStatus.WARN,
    Health.LOST: DiagnosticStatus.ERROR,
}


def step_period_ns(dt_s: float) -> int:
    """The control step in whole nanoseconds."""
    return round(dt_s * _NS_PER_S)


def set_time(stamp: Time, nanoseconds: int) -> None:
    stamp.sec, stamp.nanosec = divmod(nanoseconds, _NS_PER_S)


def is_mute(event: FaultEvent) -> bool:
    """Whether the gate says that it withheld a robot's command."""
    return bool(event.kind == FaultEvent.EFFECT and event.applied == FaultEvent.WITHHELD)


@dataclass(frozen=True, slots=True)
class Commanded:
    """What the sim reads of an Action."""

    episode: int
    step: int
    action: int
    fault: int


def command_from_bytes(data: bytes) -> Commanded:
    """A serialized Action.

    Raises:
        UserError: not little-endian CDR, or cut short.
    """
    start = body_at("command", data)
    try:
        episode, step, action, _, fault = COMMANDED.unpack_from(data, start)
    except struct.error as error:
        raise cut_short("command", data, error) from error
    return Commanded(episode, step, action, fault)


class ObservationWriter:
    """One serialized Observation per robot, refilled for every step. All share ``header``."""

    def __init__(self, spec: EnvSpec, header: Header) -> None:
        self._header = header
        self._frame_id = header.frame_id.encode() + b"\0"
        self._padding = b"\0" * (-len(self._frame_id) % 4)
        self._n_features = COUNT.pack(spec.obs_size)
        self._n_actions = COUNT.pack(spec.n_actions)
        self.messages: list[bytes] = [b""] * spec.n_robots

    def fill(self, session: Session) -> None:
        stamp = self._header.stamp
        head = (
            _HEAD.pack(LITTLE_ENDIAN, stamp.sec, stamp.nanosec, len(self._frame_id))
            + self._frame_id
            + self._padding
        )
        obs, available = session.obs, session.available
        for i, last_action in enumerate(session.last_actions.tolist()):
            self.messages[i] = b"".join(
                (
                    head,
                    OBSERVED.pack(session.episode, session.step, last_action),
                    self._n_features,
                    obs[i].tobytes(),
                    self._n_actions,
                    available[i].tobytes(),
                )
            )


class EpisodeWriter:
    """The EpisodeState message, refilled for every step."""

    def __init__(self, spec: EnvSpec, seed: int, header: Header) -> None:
        n = spec.n_robots
        message = EpisodeState(header=header, seed=seed)
        message.state = array("f", bytes(4 * spec.state_size))
        message.crashed = array("B", bytes(n))
        message.positions_m = array("f", bytes(8 * n))
        message.actions = array("i", bytes(4 * n))
        self.message = message
        self._no_actions = array("i")
        self._all_actions = message.actions
        self._actions = np.frombuffer(self._all_actions, dtype=np.int32)
        self._state = np.frombuffer(message.state, dtype=np.float32)
        self._crashed = np.frombuffer(message.crashed, dtype=np.uint8)
        self._positions = np.frombuffer(message.positions_m, dtype=np.float32)

    def fill(self, session: Session) -> EpisodeState:
        message = self.message
        message.episode = session.episode
        message.step = session.step
        message.reward = session.reward
        message.episode_return = session.episode_return
        message.terminated = session.terminated
        message.truncated = session.truncated
        message.success = session.success
        message.trajectory_hash = session.trajectory_hash
        self._actions[:] = session.last_actions
        message.actions = self._all_actions if session.step else self._no_actions
        self._state[:] = session.state
        self._crashed[:] = session.crashed
        self._positions[:] = session.env.positions_m[0].ravel()
        return message


def odometry(session: Session, header: Header, robot: int) -> Odometry:
    """Pose in the map frame; twist in the robot's frame, whose axes are the map's."""
    message = Odometry(header=header)
    message.child_frame_id = f"{session.env.spec.robots[robot]}/base_link"
    x, y = session.env.positions_m[0, robot].tolist()
    vx, vy = session.env.velocities_mps[0, robot].tolist()
    message.pose.pose.position.x, message.pose.pose.position.y = x, y
    message.pose.pose.orientation.w = 1.0
    message.twist.twist.linear.x, message.twist.twist.linear.y = vx, vy
    return message


def markers(session: Session, header: Header) -> MarkerArray:
    """Robots (crashed ones red), opponents, boxes, sites (green once done), the arena's outline.

    The dead are deleted: their markers would stay where they fell.
    """
    env, scene = session.env, session.env.scene
    result = MarkerArray()
    places = env.world.bodies[0, :, :2].tolist()
    angles = env.world.turns[0, :, 0].tolist()
    health, _ = vitals(env, 0)
    for i, actor in enumerate(actors(env)):
        side = 2 * actor.radius_m
        width, depth = actor.size_m or (side, side)
        kind = Marker.CYLINDER if actor.size_m is None else Marker.CUBE
        crashed = actor.side is Side.ROBOTS and bool(session.crashed[i])
        colour = _RED if crashed else _COLOURS[actor.side]
        size = (width, depth, _BODY_HEIGHT_M)
        marker = _solid(header, actor.side.name.lower(), i, kind, places[i], size, colour)
        marker.pose.orientation.z = math.sin(angles[i] / 2)
        marker.pose.orientation.w = math.cos(angles[i] / 2)
        if health[i] <= 0:
            marker.action = Marker.DELETE
        result.markers.append(marker)
    round_sites = scene.site_radius_m > 0
    kind = Marker.CYLINDER if round_sites else Marker.CUBE
    side = 2 * scene.site_radius_m if round_sites else scene.cell_m
    for i, place in enumerate(scene.sites_m):
        colour = _GREEN if env.sites_done[0, i] else _YELLOW
        size = (side, side, _SITE_HEIGHT_M)
        result.markers.append(_solid(header, "sites", i, kind, place, size, colour))
    result.markers.append(_outline(header, scene))
    return result


def _solid(
    header: Header,
    namespace: str,
    number: int,
    kind: int,
    centre_m: Sequence[float],
    size_m: tuple[float, float, float],
    colour: ColorRGBA,
) -> Marker:
    """A cylinder or box of (width, depth, height), parallel to the axes, on the floor."""
    marker = Marker(header=header, ns=namespace, id=number, type=kind, color=colour)
    marker.pose.position.x, marker.pose.position.y = centre_m
    marker.pose.position.z = size_m[2] / 2
    marker.pose.orientation.w = 1.0
    marker.scale.x, marker.scale.y, marker.scale.z = size_m
    return marker


def _outline(header: Header, scene: Scene) -> Marker:
    marker = Marker(header=header, ns="arena", type=Marker.LINE_STRIP, color=_GREY)
    marker.pose.orientation.w = 1.0
    marker.scale.x = 0.05
    width, height = scene.arena_m
    corners = ((0.0, 0.0), (width, 0.0), (width, height), (0.0, height), (0.0, 0.0))
    marker.points = [Point(x=x, y=y) for x, y in corners]
    return marker


def diagnostics(
    decided: Decisions | NewestCommands, session: Session, stamp: Time, problems: Sequence[str]
) -> DiagnosticArray:
    """One status per robot: OK, WARN where a plan faults it, ERROR where it is lost.

    ``problems``: what else is wrong about each robot, or '': at least WARN.
    """
    message = DiagnosticArray()
    message.header.stamp = stamp
    for i, robot in enumerate(session.env.spec.robots):
        state = decided.health[i]
        values = {
            "state": state.name.lower(),
            "episode": session.episode,
            "step": session.step,
            "late": decided.late[i],
            "duplicates": decided.duplicates[i],
        }
        message.status.append(
            DiagnosticStatus(
                level=max(
                    _LEVELS[state], DiagnosticStatus.WARN if problems[i] else DiagnosticStatus.OK
                ),
                name=f"sim: {robot}",
                message="; ".join(filter(None, (state.value, problems[i]))),
                hardware_id=robot,
                values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
            )
        )
    return message
