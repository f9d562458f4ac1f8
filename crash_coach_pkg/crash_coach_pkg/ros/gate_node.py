"""Executable ``gate``: the data plane. Relays command_raw to command, faulted as planned."""

from __future__ import annotations

import sys
import time
from functools import partial

import numpy as np
from crash_coach_interfaces.msg import Action, CrashPlan, FaultEvent, Observation
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.executors import Executor
from rclpy.node import Node

from crash_coach_pkg.gate_state import NOTHING_APPLIED, Decision, EventKind, GateState, Outputs
from crash_coach_pkg.plan import Mode
from crash_coach_pkg.ros.convert import (
    bytes_from_decision,
    command_from_bytes,
    effect_from_decision,
    message_from_event,
    plan_from_message,
)
from crash_coach_pkg.ros.run import (
    EVENTS,
    NEWEST,
    PLAN,
    TICK_S,
    refuse_unknown_parameters,
    robot_names,
    spin,
)
from sim_pkg.contract import UserError

LOCKSTEP = ParameterDescriptor(
    description="Hold the commands of an episode until its plan is there, and those under a "
    "random fault until their observation is there. False (real time): never hold.",
    read_only=True,
)
FIRST_LEASE = ParameterDescriptor(
    description="Lock-step: how long the first commands are held for a coach that has not spoken "
    "yet, seconds.",
    read_only=True,
    floating_point_range=[FloatingPointRange(from_value=0.0, to_value=600.0)],
)


class GateNode(Node):
    """Parameters: robots, lockstep, first_lease_s.

    Raises:
        UserError: a parameter is missing, unknown or wrong.
    """

    def __init__(self, context: Context | None = None) -> None:
        super().__init__("gate", context=context)
        self._robots = robot_names(self)
        lockstep: bool = self.declare_parameter("lockstep", True, LOCKSTEP).value
        first_lease_s: float = self.declare_parameter("first_lease_s", 10.0, FIRST_LEASE).value
        refuse_unknown_parameters(self)
        self._state = GateState(len(self._robots), lockstep, first_lease_s)
        self._watched: set[int] = set()
        self._events = self.create_publisher(FaultEvent, "/coach/events", EVENTS)
        self._commands = [
            self.create_publisher(Action, f"/{name}/command", NEWEST) for name in self._robots
        ]
        for robot, name in enumerate(self._robots):
            self.create_subscription(
                Action,
                f"/{name}/command_raw",
                partial(self._on_command, robot),
                NEWEST,
                raw=True,
            )
        self.create_subscription(CrashPlan, "/coach/plan", self._on_plan, PLAN)
        self.create_timer(TICK_S, self._on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _on_command(self, robot: int, data: bytes) -> None:
        try:
            command = command_from_bytes(robot, data)
        except UserError as error:
            self.get_logger().error(f"{self._robots[robot]}: {error}; ignored")
            return
        self._send(self._state.command(command, time.monotonic()))

    def _on_plan(self, message: CrashPlan) -> None:
        try:
            plan = plan_from_message(message, self._robots)
        except ValueError as error:
            self.get_logger().error(f"plan {message.revision} refused: {error}")
            return
        outputs = self._state.plan(plan, message.lease_s, time.monotonic())
        self._watch_observations()
        self._send(outputs)

    def _watch_observations(self) -> None:
        """Availability is needed from the first random fault of a robot on."""
        for robot in self._state.randomised_robots - self._watched:
            self._watched.add(robot)
            self.create_subscription(
                Observation,
                f"/{self._robots[robot]}/observation",
                partial(self._on_observation, robot),
                NEWEST,
            )

    def _on_observation(self, robot: int, message: Observation) -> None:
        available = np.frombuffer(message.available_actions, dtype=np.uint8) != 0
        now_s = time.monotonic()
        self._send(self._state.observation(robot, message.episode, message.step, available, now_s))

    def _on_tick(self) -> None:
        self._send(self._state.tick(time.monotonic()))

    def _send(self, outputs: Outputs) -> None:
        for output in outputs:
            if isinstance(output, Decision):
                self._send_decision(output)
                continue
            if output.kind == EventKind.EXPIRED:
                self.get_logger().warning("the coach is silent: every fault is cleared")
            stamp = self.get_clock().now().to_msg()
            self._events.publish(message_from_event(output, stamp))

    def _send_decision(self, decision: Decision) -> None:
        withheld = decision.applied == NOTHING_APPLIED
        if not withheld:
            self._commands[decision.command.robot].publish(bytes_from_decision(decision))
        # Repeated only where the receiver has nothing else to go by: one EFFECT per robot-step.
        if withheld or (decision.mode != Mode.NONE and not decision.repeated):
            self._events.publish(effect_from_decision(decision, self._robots))


def start(executor: Executor) -> Node:
    """A gate on ``executor``."""
    node = GateNode()
    executor.add_node(node)
    return node


def main() -> int:
    return spin(start)


if __name__ == "__main__":
    sys.exit(main())
