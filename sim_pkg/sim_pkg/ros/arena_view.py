"""The arena for whoever draws it: what never moves, latched, and what moves, at a viewer's pace."""

from __future__ import annotations

from array import array
from collections.abc import Callable

import numpy as np
from crash_coach_interfaces.msg import Arena, ArenaState
from rclpy.node import Node
from std_msgs.msg import Header

from crash_coach_common.contract import BoolArray, FloatArray
from crash_coach_common.ros.qos import ARENA, NEWEST
from sim_pkg.env import Env
from sim_pkg.render.frames import actors, vitals, walled_m
from sim_pkg.session import Session

ARENA_TOPIC = "sim/arena"
ARENA_STATE_TOPIC = "sim/arena_state"


def arena_message(env: Env, lockstep: bool, header: Header) -> Arena:
    """The still part of an environment's first arena."""
    scene, taking_part = env.scene, actors(env)
    return Arena(
        header=header,
        scenario=env.spec.scenario,
        lockstep=lockstep,
        dt_s=env.spec.dt_s,
        action_names=list(env.spec.action_names),
        arena_m=list(scene.arena_m),
        walled_m=list(walled_m(env)),
        cell_m=float(scene.cell_m),
        site_name=scene.site_name,
        site_radius_m=float(scene.site_radius_m),
        sites_m=_flat(scene.sites_m),
        rough_m=_flat(scene.rough_m),
        actors=[actor.name for actor in taking_part],
        kinds=[actor.kind for actor in taking_part],
        sides=[int(actor.side) for actor in taking_part],
        radii_m=[float(actor.radius_m) for actor in taking_part],
        sizes_m=_flat([actor.size_m or (0.0, 0.0) for actor in taking_part]),
    )


def _flat(rows: tuple[tuple[float, ...], ...] | list[tuple[float, float]]) -> list[float]:
    return [float(x) for row in rows for x in row]


def arena_state(session: Session, header: Header) -> ArenaState:
    """What moves, as it is now."""
    env = session.env
    bodies, turns = env.world.bodies[0], env.world.turns[0]
    poses = np.concatenate([bodies[:, :2], turns[:, :1]], axis=1)
    health, shield = vitals(env, 0)
    message = ArenaState(
        header=header,
        episode=session.episode,
        step=session.step,
        episode_return=session.episode_return,
        ended=not session.running,
        success=session.success,
    )
    message.poses = _floats(poses)
    message.health, message.shield = _floats(health), _floats(shield)
    message.sites_done = _bytes(env.sites_done[0])
    message.crashed = array("B", session.crashed.tobytes())
    message.actions = array("i", session.last_actions.astype(np.int32).tobytes())
    if session.step:
        hit, hitter = np.nonzero(env.hits[0])
        pairs = np.stack([hitter, hit], axis=1).astype(np.uint16)
        message.hits = array("H", pairs.tobytes())
    return message


def _floats(values: FloatArray) -> array[float]:
    return array("f", np.ascontiguousarray(values, dtype=np.float32).tobytes())


def _bytes(flags: BoolArray) -> array[int]:
    return array("B", flags.astype(np.uint8).tobytes())


class ArenaView:
    """Publishes both while somebody listens; ``clock_s`` is a steady clock.

    A viewer's pace, not the step's: in lock-step hundreds of steps pass per second, and nobody
    sees them all. The newest state always comes in the end: ``catch_up`` is called often.
    """

    def __init__(
        self, node: Node, env: Env, lockstep: bool, hz: float, clock_s: Callable[[], float]
    ) -> None:
        self._clock_s = clock_s
        self._period_s = 1 / hz
        self._due_s = 0.0
        self._listened = self._pending = False
        self._header = Header(frame_id="map")
        self._arena_pub = node.create_publisher(Arena, ARENA_TOPIC, ARENA)
        self._state_pub = node.create_publisher(ArenaState, ARENA_STATE_TOPIC, NEWEST)
        self._arena_pub.publish(arena_message(env, lockstep, self._header))

    def refresh_listeners(self) -> None:
        self._listened = self._state_pub.get_subscription_count() > 0

    def look(self, session: Session, header: Header) -> None:
        """After every step, with the header of its observations."""
        if not self._listened:
            return
        now_s = self._clock_s()
        self._pending = now_s < self._due_s
        if not self._pending:
            self._due_s = now_s + self._period_s
            self._state_pub.publish(arena_state(session, header))

    def catch_up(self, session: Session, header: Header) -> None:
        """Publishes a state that came too soon after the one before it, if none came since."""
        if self._pending:
            self.look(session, header)
