"""Core types to messages: no Node, no publishing.

The message objects are made once; what changes in every step is written through numpy views of
their arrays, so a step costs no allocation and no loop over elements.
"""

from __future__ import annotations

from array import array

import numpy as np
import numpy.typing as npt
from builtin_interfaces.msg import Time
from crash_coach_interfaces.msg import EpisodeState, FaultEvent, Observation
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point
from nav_msgs.msg import Odometry
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from sim_pkg.contract import EnvSpec
from sim_pkg.lockstep import Health
from sim_pkg.scenarios.base import Scene
from sim_pkg.session import Session

MAP_FRAME = "map"
_NS_PER_S = 1_000_000_000
_RED = ColorRGBA(r=0.85, g=0.15, b=0.15, a=1.0)
_BLUE = ColorRGBA(r=0.2, g=0.4, b=0.85, a=1.0)
_YELLOW = ColorRGBA(r=0.95, g=0.75, b=0.1, a=1.0)
_GREEN = ColorRGBA(r=0.2, g=0.7, b=0.3, a=1.0)
_GREY = ColorRGBA(r=0.5, g=0.5, b=0.5, a=1.0)
_ROBOT_HEIGHT_M = 0.3
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
    return bool(event.kind == FaultEvent.EFFECT and event.applied < 0)


class ObservationWriter:
    """One Observation per robot, refilled for every step. All share ``header``."""

    def __init__(self, spec: EnvSpec, header: Header) -> None:
        self.messages = [Observation(header=header) for _ in spec.robots]
        self._features: list[npt.NDArray[np.float32]] = []
        self._available: list[npt.NDArray[np.uint8]] = []
        for message in self.messages:
            message.features = array("f", bytes(4 * spec.obs_size))
            message.available_actions = array("B", bytes(spec.n_actions))
            self._features.append(np.frombuffer(message.features, dtype=np.float32))
            self._available.append(np.frombuffer(message.available_actions, dtype=np.uint8))

    def fill(self, session: Session) -> None:
        obs, available = session.obs, session.available
        last_actions = session.last_actions.tolist()
        for i, message in enumerate(self.messages):
            message.episode = session.episode
            message.step = session.step
            message.last_action = last_actions[i]
            self._features[i][:] = obs[i]
            self._available[i][:] = available[i]


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
    """Robots (crashed ones red), sites (green once done) and the arena's outline."""
    scene = session.env.scene
    result = MarkerArray()
    for i, (x, y) in enumerate(session.env.positions_m[0].tolist()):
        colour = _RED if session.crashed[i] else _BLUE
        size = 2 * scene.radii_m[i]
        result.markers.append(
            _solid(header, "robots", i, Marker.CYLINDER, (x, y), (size, _ROBOT_HEIGHT_M), colour)
        )
    for i, (x, y) in enumerate(scene.sites_m):
        colour = _GREEN if session.env.sites_done[0, i] else _YELLOW
        size = scene.cell_m or 1.0
        result.markers.append(_solid(header, "sites", i, Marker.CUBE, (x, y), (size, 0.02), colour))
    result.markers.append(_outline(header, scene))
    return result


def _solid(
    header: Header,
    namespace: str,
    number: int,
    kind: int,
    centre_m: tuple[float, float],
    size_m: tuple[float, float],
    colour: ColorRGBA,
) -> Marker:
    """A cylinder or box of (width, height) that stands on the floor."""
    marker = Marker(header=header, ns=namespace, id=number, type=kind, color=colour)
    marker.pose.position.x, marker.pose.position.y = centre_m
    marker.pose.position.z = size_m[1] / 2
    marker.pose.orientation.w = 1.0
    marker.scale.x = marker.scale.y = size_m[0]
    marker.scale.z = size_m[1]
    return marker


def _outline(header: Header, scene: Scene) -> Marker:
    marker = Marker(header=header, ns="arena", type=Marker.LINE_STRIP, color=_GREY)
    marker.pose.orientation.w = 1.0
    marker.scale.x = 0.05
    width, height = scene.arena_m
    corners = ((0.0, 0.0), (width, 0.0), (width, height), (0.0, height), (0.0, 0.0))
    marker.points = [Point(x=x, y=y) for x, y in corners]
    return marker


def diagnostics(robots: tuple[str, ...], health: list[Health], stamp: Time) -> DiagnosticArray:
    """One status per robot: OK, WARN where a plan faults it, ERROR where it is lost."""
    message = DiagnosticArray()
    message.header.stamp = stamp
    for robot, state in zip(robots, health, strict=True):
        message.status.append(
            DiagnosticStatus(
                level=_LEVELS[state],
                name=f"sim: {robot}",
                message=state.value,
                hardware_id=robot,
                values=[KeyValue(key="state", value=state.name.lower())],
            )
        )
    return message
