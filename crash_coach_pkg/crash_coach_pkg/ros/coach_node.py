"""Executable ``coach``: the control plane. Decides who crashes, when and how.

Two nodes in one process: ``/coach`` with the parameters and services, served by a thread of its
own, because a change with ``apply_at: next_step`` waits there for the gate's answer; and
``/coach_link`` with the topics, which must go on meanwhile.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from crash_coach_interfaces.msg import CrashPlan as CrashPlanMessage
from crash_coach_interfaces.msg import EpisodeState, FaultEvent
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from crash_coach_pkg.control import Control
from crash_coach_pkg.parameters import (
    ParameterSpec,
    Value,
    build_settings,
    check_change,
    parameter_specs,
)
from crash_coach_pkg.plan import CrashPlan
from crash_coach_pkg.ros.convert import message_from_plan, played_from_bytes
from crash_coach_pkg.ros.run import (
    EPISODE,
    EVENTS,
    PLAN,
    SPIN_S,
    TICK_S,
    refuse_unknown_parameters,
    robot_names,
    spin,
)
from sim_pkg.contract import UserError

ARM_TIMEOUT_S = 2.0
HEARTBEATS_PER_LEASE = 3
# When they change, the running episode need not be planned again.
NOT_IN_PLAN = frozenset(("apply_at", "lease_s", "block_episodes", "curriculum_episodes"))


class CoachLink(Node):
    """Follows episodes, publishes plans and heartbeats. ``changed`` guards ``control``."""

    def __init__(
        self,
        control: Control,
        robots: tuple[str, ...],
        check: Callable[[], None],
        context: Context | None = None,
    ) -> None:
        super().__init__(
            "coach_link",
            context=context,
            use_global_arguments=False,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self.control = control
        self.changed = threading.Condition()
        self.armed_revision = 0
        self._robots = robots
        self._check = check
        self._due_s = 0.0
        self._plans = self.create_publisher(CrashPlanMessage, "/coach/plan", PLAN)
        self.create_subscription(EpisodeState, "/sim/boundary", self._on_episode, EPISODE, raw=True)
        self.create_subscription(FaultEvent, "/coach/events", self._on_event, EVENTS)
        self.create_timer(TICK_S, self._on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def publish(self, plan: CrashPlan | None) -> None:
        """Call with ``changed`` held; None publishes nothing."""
        if plan is None:
            return
        lease_s = self.control.settings.lease_s
        self._due_s = time.monotonic() + lease_s / HEARTBEATS_PER_LEASE - TICK_S
        stamp = self.get_clock().now().to_msg()
        self._plans.publish(message_from_plan(plan, self._robots, lease_s, stamp))

    def _on_episode(self, data: bytes) -> None:
        try:
            played = played_from_bytes(data)
        except UserError as error:
            self.get_logger().error(f"{error}; ignored")
            return
        with self.changed:
            self.publish(self.control.follow(played.episode))
            record = self.control.finish(played.success) if played.ended else None
        if record is not None:
            self.get_logger().info(f"block: {record}")

    def _on_event(self, message: FaultEvent) -> None:
        with self.changed:
            if self.armed_revision == 0:  # later, a newer coach would be fought over every event
                self.publish(self.control.overtake(message.revision))
            if message.kind == FaultEvent.ARMED and self.control.published(message.revision):
                self.armed_revision = message.revision
                self.changed.notify_all()

    def _on_tick(self) -> None:
        self._check()
        with self.changed:
            if time.monotonic() >= self._due_s:
                self.publish(self.control.plan)


class CoachNode(Node):
    """Parameters and services. Put ``link`` on an executor and call ``start``.

    Raises:
        UserError: a parameter is missing, unknown or wrong.
    """

    def __init__(self, context: Context | None = None) -> None:
        super().__init__("coach", context=context)
        self._robots = robot_names(self)
        self._values: dict[str, Value] = {}
        self._unconfirmed = ""  # why no gate confirmed the last change that was made all the same
        for spec in parameter_specs():
            self._values[spec.name] = self.declare_parameter(
                spec.name, _parameter_value(spec.default), _descriptor(spec)
            ).value
        refuse_unknown_parameters(self)
        settings = build_settings(self._values, self._robots)
        # Seconds grow over restarts, so that a new coach's first plan is newer than the last one
        # of the coach before it.
        control = Control(settings, self._robots, revision=int(time.time()))
        self.link = CoachLink(control, self._robots, self._check_thread, context)
        self._stop = threading.Event()
        self._threads = ThreadPoolExecutor(1, thread_name_prefix="coach parameters")
        self._served: Future[None] | None = None
        self.add_on_set_parameters_callback(self._on_set)
        self.create_service(Trigger, "/coach/clear_all", self._on_clear_all)

    def start(self) -> None:
        """Serves parameters and services in a thread."""
        self._served = self._threads.submit(self._serve)

    def destroy_node(self) -> None:
        self._stop.set()
        self._threads.shutdown()
        self.link.destroy_node()
        super().destroy_node()

    def _serve(self) -> None:
        executor = SingleThreadedExecutor(context=self.context)
        executor.add_node(self)
        while not self._stop.is_set():
            try:
                executor.spin_once(timeout_sec=SPIN_S)
            except ExternalShutdownException:
                return

    def _check_thread(self) -> None:
        """Raises on the link's thread what ended the other one."""
        if self._served is not None and self._served.done():
            self._served.result()

    def _on_set(self, parameters: list[Parameter]) -> SetParametersResult:
        changed = {parameter.name: parameter.value for parameter in parameters}
        values = {**self._values, **{k: v for k, v in changed.items() if k in self._values}}
        try:
            settings = build_settings(values, self._robots)
            check_change(settings, tuple(changed))
        except UserError as error:
            return SetParametersResult(successful=False, reason=str(error))
        disabling = "enabled" in changed and not settings.enabled
        now = settings.apply_at == "next_step" and not set(changed) <= NOT_IN_PLAN
        with self.link.changed:
            before = self.link.control.snapshot()
            plan = self.link.control.configure(settings, now=now or disabling)
            self.link.publish(plan)
            answer = "" if plan is None else self._await_gate(plan)
            if answer and not disabling:
                self.link.publish(self.link.control.restore(before))
                return SetParametersResult(successful=False, reason=answer)
        self._values, self._unconfirmed = values, answer
        return SetParametersResult(successful=True)

    def _await_gate(self, plan: CrashPlan) -> str:
        """Waits for ARMED, with ``changed`` held; returns what is wrong, or nothing."""
        armed = self.link.changed.wait_for(
            lambda: self.link.armed_revision >= plan.revision, timeout=ARM_TIMEOUT_S
        )
        return "" if armed else f"no gate armed the plan within {ARM_TIMEOUT_S:g} s"

    def _on_clear_all(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        result = self.set_parameters_atomically([Parameter("enabled", value=False)])
        problem = self._unconfirmed if result.successful else result.reason
        response.success = not problem
        response.message = (
            f"enabled is now false, but {problem}"
            if problem
            else "every fault is cleared; enabled is now false"
        )
        return response


def _parameter_value(value: Value) -> Value:
    return value if isinstance(value, bool | int | float | str) else list(value)


def _descriptor(spec: ParameterSpec) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(description=spec.description)
    if spec.low is None or spec.high is None:
        return descriptor
    if isinstance(spec.default, int):
        descriptor.integer_range = [IntegerRange(from_value=int(spec.low), to_value=int(spec.high))]
    else:
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(spec.low), to_value=float(spec.high))
        ]
    return descriptor


def start(executor: Executor) -> Node:
    """A coach on ``executor``."""
    node = CoachNode()
    executor.add_node(node.link)
    node.start()
    return node


def main() -> int:
    return spin(start)


if __name__ == "__main__":
    sys.exit(main())
