"""What every gate does, whatever its robots' commands are: plans, events, telemetry."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import Protocol

from crash_coach_interfaces.msg import CrashPlan as CrashPlanMessage
from crash_coach_interfaces.msg import FaultEvent
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import QoSProfile

from crash_coach_common.contract import UserError
from crash_coach_common.ros.parameters import (
    CheckedParameterService,
    choices_text,
    refuse_undeclared,
)
from crash_coach_common.ros.peers import several
from crash_coach_common.ros.qos import EVENTS, PLAN
from crash_coach_common.ros.qos_node import QosNode
from crash_coach_common.ros.run_node import TICK_S
from crash_coach_pkg.gate.health import Decided, Report, RobotState, TeamHealth
from crash_coach_pkg.gate.plan_book import Event, EventKind, PlanBook
from crash_coach_pkg.plan import CrashPlan
from crash_coach_pkg.ros.convert import message_from_event, message_from_plan, plan_from_message
from crash_coach_pkg.ros.endpoints import WatchedPublisher
from crash_coach_pkg.ros.robot_names import robot_names
from crash_coach_pkg.ros.robot_topics import RobotTopics

ACTION_TYPE = "crash_coach_interfaces/msg/Action"
DIAGNOSTICS_S = 1.0
_LEVELS = {
    RobotState.OK: DiagnosticStatus.OK,
    RobotState.MUTED: DiagnosticStatus.WARN,
    RobotState.LOST: DiagnosticStatus.ERROR,
}


class Gate(Protocol):
    """What is attached to a GateBase: it relays one type of commands."""

    @property
    def book(self) -> PlanBook: ...

    @property
    def type_name(self) -> str:
        """Of the commands, package/msg/Type; empty while it is not known yet."""
        ...

    def plan(self, plan: CrashPlan, lease_s: float, now_s: float) -> None:
        """Takes a plan or its heartbeat, and sends what follows from it."""
        ...

    def tick(self, now_s: float) -> None:
        """Every TICK_S of a steady clock; ends leases."""
        ...

    def decided(self) -> Sequence[Decided]:
        """The newest robot-step of each robot, for /diagnostics."""
        ...

    def counters(self, robot: int) -> Sequence[tuple[str, int]]:
        """What else /diagnostics tells of a robot."""
        ...

    def warning(self, robot: int) -> str:
        """What an operator should know of a robot beside its state; empty: nothing."""
        ...

    def close(self) -> None: ...


class GateBase(QosNode):
    """Parameters: robots, command_type, cmd_timeout_s, and those of RobotTopics.

    What is attached declares its own, before ``serve`` refuses those that nobody declared.

    Raises:
        UserError: a parameter is missing or wrong.
    """

    def __init__(self, context: Context | None = None) -> None:
        super().__init__("gate", context=context, start_parameter_services=False)
        self._parameter_services = CheckedParameterService(self)
        self.robots = robot_names(self)
        self.command_type = self.text(
            "command_type",
            ACTION_TYPE,
            "Type of the robots' commands, package/msg/Type; auto: the one that is published on "
            "the raw topics, once somebody does.",
        )
        actions = self.command_type == ACTION_TYPE
        defaults = ("command_raw", "command") if actions else ("cmd_vel_raw", "cmd_vel")
        self.topics = RobotTopics(self, self.robots, defaults)
        cmd_timeout_s = self.number(
            "cmd_timeout_s",
            1.0,
            (0.001, 3600.0),
            "/diagnostics calls a robot lost when no command came for so long, seconds.",
        )
        self.health = TeamHealth(len(self.robots), cmd_timeout_s)
        self._gate: Gate | None = None
        self._outputs: list[tuple[int, WatchedPublisher]] = []
        self._events = self.create_publisher(FaultEvent, "coach/events", EVENTS)
        self._in_force = self.create_publisher(CrashPlanMessage, "coach/plan_in_force", PLAN)
        self._diagnostics = self.create_publisher(
            DiagnosticArray, "diagnostics", QoSProfile(depth=10)
        )

    # --- for what is attached ---------------------------------------------------------------

    def text(self, name: str, default: str, description: str, choices: Sequence[str] = ()) -> str:
        """Declares a read-only parameter. Raises UserError where it is empty."""
        descriptor = ParameterDescriptor(
            description=description, additional_constraints=choices_text(choices), read_only=True
        )
        value: str = self.declare_parameter(name, default, descriptor).value
        if not value:
            raise UserError(f"parameter {name!r} of {self.get_name()} is empty")
        return value

    def number(
        self, name: str, default: float, limits: tuple[float, float], description: str
    ) -> float:
        """Declares a read-only parameter within ``limits``."""
        low, high = limits
        descriptor = ParameterDescriptor(
            description=description,
            read_only=True,
            floating_point_range=[FloatingPointRange(from_value=low, to_value=high)],
        )
        value: float = self.declare_parameter(name, default, descriptor).value
        return value

    def flag(self, name: str, default: bool, description: str) -> bool:
        """Declares a read-only parameter."""
        descriptor = ParameterDescriptor(description=description, read_only=True)
        value: bool = self.declare_parameter(name, default, descriptor).value
        return value

    def command_publisher(
        self,
        robot: int,
        type_: type,
        qos: QoSProfile,
        events: PublisherEventCallbacks | None = None,
    ) -> WatchedPublisher:
        """Publishes what ``robot`` gets; others that do so too are reported as intruders."""
        publisher = WatchedPublisher(self, type_, self.topics.commands[robot], qos, events)
        self._outputs.append((robot, publisher))
        return publisher

    def serve(self, gate: Gate) -> None:
        """Carries out plans with ``gate`` from now on.

        Raises:
            UserError: a parameter that neither this node nor the gate has declared.
        """
        refuse_undeclared(self)
        self._gate = gate
        self.create_subscription(CrashPlanMessage, "coach/plan", self._on_plan, PLAN)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(TICK_S, lambda: gate.tick(time.monotonic()), clock=steady)
        self.create_timer(DIAGNOSTICS_S, lambda: self._on_diagnostics(gate), clock=steady)
        self._tell_plan()  # a coach that starts need not wait for what is in force
        team = ", ".join(self.robots)
        self.get_logger().info(f"ready: relays commands ({self.command_type}) of {team}")

    def send_events(self, events: Iterable[Event]) -> None:
        """To /coach/events; a plan that they change to /coach/plan_in_force."""
        for event in events:
            stamp = self.get_clock().now().to_msg()
            self._events.publish(message_from_event(event, self.robots, stamp))
            if event.kind in (EventKind.ARMED, EventKind.EXPIRED):
                self._tell_plan()
            if event.kind == EventKind.EXPIRED:
                self.get_logger().warning("the coach is silent: every fault is cleared")
            elif event.kind == EventKind.REFUSED:
                self.get_logger().error(f"plan {event.revision} refused: {event.detail}")

    def send_effect(self, message: FaultEvent) -> None:
        self._events.publish(message)

    # --- plans and telemetry ----------------------------------------------------------------

    def _on_plan(self, message: CrashPlanMessage) -> None:
        assert self._gate is not None  # subscribed in ``serve``
        try:
            plan = plan_from_message(message, self.robots)
        except UserError as error:
            book = self._gate.book
            self.send_events(book.refused(message.episode, message.revision, str(error)))
            return
        self._gate.plan(plan, message.lease_s, time.monotonic())

    def _tell_plan(self) -> None:
        assert self._gate is not None
        book, stamp = self._gate.book, self.get_clock().now().to_msg()
        self._in_force.publish(message_from_plan(book.in_force, self.robots, book.lease_s, stamp))

    def _on_diagnostics(self, gate: Gate) -> None:
        self._look_for_intruders(gate)
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        for report in self.health.reports(gate.decided(), time.monotonic()):
            message.status.append(self._status(gate, report))
        self._diagnostics.publish(message)

    def _status(self, gate: Gate, report: Report) -> DiagnosticStatus:
        refusal = gate.book.refusal
        wrong, listeners = self._mismatches(gate, report.robot)
        # Who publishes another type is there: "nobody" would be a lie.
        warnings = [
            wrong or gate.warning(report.robot),
            listeners,
            f"plan refused: {refusal}" if refusal else "",
            several(self, "coach/plan"),
            several(self, self.topics.raw[report.robot]),
        ]
        warning = "; ".join(text for text in warnings if text)
        level, values = _LEVELS[report.state], dict(report.values)
        if level == DiagnosticStatus.OK and (warning or "intruders" in values):
            level = DiagnosticStatus.WARN
        counters = (*gate.counters(report.robot), ("ignored_plans", gate.book.ignored))
        values |= {key: str(value) for key, value in counters}
        name = self.robots[report.robot]
        return DiagnosticStatus(
            level=level,
            name=f"gate: {name}",
            message="; ".join(text for text in (report.text, warning) if text),
            hardware_id=name,
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )

    def _mismatches(self, gate: Gate, robot: int) -> tuple[str, str]:
        """Publishers and listeners of another type."""
        topics, name = self.topics, gate.type_name
        if not name:
            return "", ""
        return topics.wrong_publishers(robot, name), topics.wrong_listeners(robot, name)

    def _look_for_intruders(self, gate: Gate) -> None:
        decided = gate.decided()
        for robot, output in self._outputs:
            sighting = output.look()
            self.health.intruders(robot, tuple(str(who) for who in output.intruders))
            at, revision = decided[robot], gate.book.revision
            count = len(output.intruders) + 1
            self.send_events(
                Event(
                    EventKind.INTRUDER,
                    at.episode,
                    at.step,
                    revision,
                    robot,
                    detail=f"{who} publishes on {output.topic_name} too ({count} publishers)",
                )
                for who in sighting.appeared
            )
            for who in sighting.appeared:
                topic = output.topic_name
                self.get_logger().warning(f"{who} publishes on {topic}, beside this gate")

    def destroy_node(self) -> None:
        if self._gate is not None:
            self._gate.close()
        super().destroy_node()
