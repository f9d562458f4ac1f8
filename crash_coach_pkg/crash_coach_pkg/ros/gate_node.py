"""Executable ``gate``: the data plane. Relays what policies want to robots, faulted as planned."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from functools import partial

from crash_coach_interfaces.msg import Action, EpisodeState, Observation
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from crash_coach_common.contract import UserError
from crash_coach_common.ros.qos import EPISODE, NEWEST
from crash_coach_common.ros.run_node import spin
from crash_coach_pkg.effects import WITHHELD
from crash_coach_pkg.gate.action_gate import GateState
from crash_coach_pkg.gate.health import Decided
from crash_coach_pkg.gate.messages import Decision, Outputs, Seen
from crash_coach_pkg.gate.plan_book import PlanBook
from crash_coach_pkg.plan import CrashPlan
from crash_coach_pkg.ros.convert import (
    bytes_from_decision,
    bytes_from_seen,
    command_from_bytes,
    effect_from_decision,
    sight_from_bytes,
    world_from_message,
)
from crash_coach_pkg.ros.gate_base import ACTION_TYPE, Gate, GateBase
from crash_coach_pkg.ros.relay_node import RelayGate


class ActionGate:
    """The gate of scenario actions, in lock-step or in real time.

    Parameters beside GateBase's: lockstep, first_lease_s, relay_observations.
    """

    def __init__(self, base: GateBase) -> None:
        self._base = base
        robots = base.robots
        lockstep = base.flag(
            "lockstep",
            True,
            "Hold the commands of an episode until its plan is there, and those under a fault "
            "that needs their observation until that is there. False (real time): never hold.",
        )
        first_lease_s = base.number(
            "first_lease_s",
            10.0,
            (0.0, 600.0),
            "Lock-step: how long the first commands are held for a coach that has not spoken "
            "yet, seconds.",
        )
        self._relays = base.flag(
            "relay_observations",
            False,
            "Relay /<robot>/observation to /<robot>/observation_seen, which policies then have to "
            "listen to: what observation faults need.",
        )
        self._state = GateState(len(robots), lockstep, first_lease_s, self._relays)
        self._watched: set[int] = set()
        self._watches_world = False
        self._told = [(0, 0)] * len(robots)  # untold and ahead, as /diagnostics said them last
        self._commands = [
            base.command_publisher(robot, Action, NEWEST).publish for robot in range(len(robots))
        ]
        base.create_subscription(EpisodeState, "sim/boundary", self._on_boundary, EPISODE)
        if not lockstep:  # there the sim waits, and says loudly what it does not get
            base.create_subscription(Clock, "clock", self._on_clock, QoSProfile(depth=10), raw=True)
        for robot, topic in enumerate(base.topics.raw):
            on_command = partial(self._on_command, robot)
            base.create_subscription(Action, topic, on_command, NEWEST, raw=True)
        self._observations = base.topics.within("observation")
        self._seen = []
        if self._relays:
            base.topics.check("observation", "observation_seen")
            for robot, topic in enumerate(base.topics.within("observation_seen")):
                self._seen.append(base.create_publisher(Observation, topic, NEWEST))
                self._watch(robot)

    # --- as Gate ----------------------------------------------------------------------------

    @property
    def book(self) -> PlanBook:
        return self._state.book

    @property
    def type_name(self) -> str:
        return ACTION_TYPE

    def plan(self, plan: CrashPlan, lease_s: float, now_s: float) -> None:
        outputs = self._state.plan(plan, lease_s, now_s)
        if outputs:
            for robot in self._state.watched_robots - self._watched:
                self._watch(robot)
            if self._state.needs_world and not self._watches_world:
                self._watches_world = True
                self._base.create_subscription(
                    EpisodeState, "sim/episode", self._on_episode, EPISODE
                )
        self._send(outputs)

    def tick(self, now_s: float) -> None:
        self._send(self._state.tick(now_s))

    def decided(self) -> Sequence[Decided]:
        decisions = [self._state.last(robot) for robot in range(len(self._base.robots))]
        return [
            Decided() if d is None else Decided(d.mode, d.command.episode, d.command.step)
            for d in decisions
        ]

    def counters(self, robot: int) -> Sequence[tuple[str, int]]:
        state = self._state
        late, ahead, untold = state.late[robot], state.ahead[robot], state.untold[robot]
        return (("late", late), ("ahead", ahead), ("untold", untold))

    def warning(self, robot: int) -> str:
        before, now = self._told[robot], (self._state.untold[robot], self._state.ahead[robot])
        self._told[robot] = now
        told = []
        if now[0] > before[0]:
            told.append("its policy does not tell its worst action: commands are withheld")
        if now[1] > before[1]:
            told.append("commands for an episode that the sim has not begun are ignored")
            self._base.get_logger().warning(f"{self._base.robots[robot]}: {told[-1]}")
        return "; ".join(told)

    def close(self) -> None:
        """Nothing is open that the node does not close."""

    # --- relaying ---------------------------------------------------------------------------

    def _watch(self, robot: int) -> None:
        """Availability is needed from the first fault of a robot that asks for it on."""
        self._watched.add(robot)
        self._base.create_subscription(
            Observation,
            self._observations[robot],
            partial(self._on_observation, robot),
            NEWEST,
            raw=True,
        )

    def _on_command(self, robot: int, data: bytes) -> None:
        now_s = time.monotonic()
        self._base.health.heard(robot, now_s)
        try:
            command = command_from_bytes(robot, data)
        except UserError as error:
            self._base.get_logger().error(f"{self._base.robots[robot]}: {error}; ignored")
            return
        self._send(self._state.command(command, now_s))

    def _on_boundary(self, message: EpisodeState) -> None:
        begins = message.step == 0 and not (message.terminated or message.truncated)
        if self._state.boundary(message.episode, begins):
            self._base.get_logger().warning(
                f"the sim was restarted: it begins episode {message.episode} (again)"
            )

    def _on_clock(self, _: bytes) -> None:
        self._base.health.sim_moved(time.monotonic())

    def _on_observation(self, robot: int, data: bytes) -> None:
        try:
            sight = sight_from_bytes(robot, data)
        except UserError as error:
            self._base.get_logger().error(f"{self._base.robots[robot]}: {error}; ignored")
            return
        self._send(self._state.observation(sight, time.monotonic()))

    def _on_episode(self, message: EpisodeState) -> None:
        try:
            world = world_from_message(message, len(self._base.robots))
        except UserError as error:
            self._base.get_logger().error(f"{error}; ignored")
            return
        self._send(self._state.world(message.episode, message.step, world, time.monotonic()))

    def _send(self, outputs: Outputs) -> None:
        for output in outputs:
            if isinstance(output, Decision):
                self._send_decision(output)
            elif isinstance(output, Seen):
                self._seen[output.sight.robot].publish(bytes_from_seen(output))
            else:
                self._base.send_events((output,))

    def _send_decision(self, decision: Decision) -> None:
        withheld = decision.applied == WITHHELD
        if not withheld:
            self._commands[decision.command.robot](bytes_from_decision(decision))
        # Repeated only where the receiver has nothing else to go by: one EFFECT per robot-step.
        if withheld or (decision.mode and not decision.observation and not decision.repeated):
            self._base.send_effect(effect_from_decision(decision, self._base.robots))


def start(executor: Executor) -> Node:
    """A gate on ``executor``."""
    base = GateBase()
    try:
        base.serve(_attach(base))
    except UserError:
        base.destroy_node()
        raise
    executor.add_node(base)
    return base


def _attach(base: GateBase) -> Gate:
    return ActionGate(base) if base.command_type == ACTION_TYPE else RelayGate(base)


def main() -> int:
    return spin(start)


if __name__ == "__main__":
    sys.exit(main())
