"""Executable ``coach``: the control plane. Decides who crashes, when and how.

Two nodes in one process: ``coach`` with the parameters and services, served by a thread of its
own, because a change with ``apply_at: next_step`` waits there for the gate's answer; and the hidden
``_coach_link`` with the topics, which must go on meanwhile.
"""

from __future__ import annotations

import random
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from crash_coach_common.contract import UserError
from crash_coach_common.ros.parameters import (
    CheckedParameterService,
    choices_text,
    refuse_undeclared,
)
from crash_coach_common.ros.qos_node import QosNode
from crash_coach_common.ros.run_node import SPIN_S, spin
from crash_coach_pkg.coach.fault_scenario import (
    ScenarioPlanner,
    find_fault_scenario,
    load_fault_scenario,
)
from crash_coach_pkg.coach.live_coach import AHEAD, Control, ControlSettings
from crash_coach_pkg.coach.parameters import (
    START_SPECS,
    ParameterSpec,
    Value,
    build_settings,
    build_team,
    check_beside,
    check_change,
    counts_now,
    parameter_specs,
)
from crash_coach_pkg.faults import is_observation_mode
from crash_coach_pkg.gate.plan_book import not_relayed
from crash_coach_pkg.plan import Planner
from crash_coach_pkg.ros.coach_link import CoachLink
from crash_coach_pkg.ros.endpoints import leaves_observations
from crash_coach_pkg.ros.robot_names import robot_names
from crash_coach_pkg.team import TeamSpec


class CoachNode(QosNode):
    """Parameters and services. Put ``link`` on an executor and call ``start``.

    Raises:
        UserError: a parameter is missing, unknown or wrong.
    """

    def __init__(self, context: Context | None = None) -> None:
        super().__init__("coach", context=context, start_parameter_services=False)
        self._parameter_services = CheckedParameterService(self, lambda: self._said)
        self._said = ""  # of the last change: since when it is armed
        robots = robot_names(self)
        self._unconfirmed = ""  # why no gate confirmed the last change that was made all the same
        start = self._declare(START_SPECS)
        self._values = self._declare(parameter_specs())
        refuse_undeclared(self)
        self._team = build_team(start, robots)
        self._scenario = str(start["fault_scenario"])
        self._endless = not start["follow_sim"]
        settings = build_settings(self._values, self._team)
        planner = scenario_planner(self._scenario, self._team, settings)
        # Seconds grow over restarts, so that a new coach's plans are newer than those before it,
        # and two that start in the same second do not number alike. ``adopt`` sees to the rest.
        revision = int(time.time()) + random.randrange(AHEAD)
        control = Control(settings, self._team, revision, planner)
        self.link = CoachLink(self, control, robots, not self._endless, self._check_thread)
        self._stop = threading.Event()
        self._threads = ThreadPoolExecutor(1, thread_name_prefix="coach parameters")
        self._served: Future[None] | None = None
        self.add_on_set_parameters_callback(self._on_set)
        self.create_service(Trigger, "coach/clear_all", self._on_clear_all)

    def _declare(self, specs: Sequence[ParameterSpec]) -> dict[str, Value]:
        return {
            spec.name: _from_ros(
                self.declare_parameter(spec.name, _to_ros(spec.default), _descriptor(spec)).value
            )
            for spec in specs
        }

    def start(self) -> None:
        """Serves parameters and services in a thread."""
        self._served = self._threads.submit(self._serve)
        how = self._scenario or f"strategy {self._values['strategy']}"
        self.get_logger().info(f"ready: {how} for {', '.join(self._team.robots)}")

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
        self._said = ""
        changed = {p.name: _from_ros(p.value) for p in parameters if p.name in self._values}
        values = {**self._values, **changed}
        try:
            check_beside(self._scenario, tuple(changed))
            settings = build_settings(values, self._team)
            check_change(settings, tuple(changed))
            self._check_gate(changed)
        except UserError as error:
            return SetParametersResult(successful=False, reason=str(error))
        disabling = "enabled" in changed and not settings.enabled
        now = counts_now(settings, changed, self._endless)
        with self.link.changed:
            self.link.settle()
            before = self.link.control.snapshot()
            plan = self.link.control.configure(settings, now=now or disabling)
            self.link.publish(plan)
            answer = "" if plan is None else self.link.await_gate(plan)
            if answer and not disabling:
                self.link.publish(self.link.control.restore(before))
                return SetParametersResult(successful=False, reason=answer)
            if plan is not None and not answer:
                self._said = self.link.armed_since
            elif now and self.link.control.plan is None:
                self._said = "no episode has begun: it counts from the first one on"
        self._values, self._unconfirmed = values, answer
        return SetParametersResult(successful=True)

    def _check_gate(self, changed: Mapping[str, Value]) -> None:
        """Raises UserError for a mode that the gate could only refuse later, with its episode."""
        mode = str(changed.get("crash_mode", ""))
        if mode and is_observation_mode(mode) and leaves_observations(self):
            raise UserError(f"the gate would refuse: {not_relayed(mode)}")

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


def scenario_planner(name: str, team: TeamSpec, settings: ControlSettings) -> Planner | None:
    """Of a fault scenario, by name or path; None for an empty name.

    Raises:
        UserError: the file is missing or wrong, or does not fit the team.
    """
    if not name:
        return None
    scenario = load_fault_scenario(find_fault_scenario(name))
    scenario.check(team)
    return ScenarioPlanner(scenario, team, settings.seed)


def _to_ros(value: Value) -> Value:
    return list(value) if isinstance(value, tuple) else value


def _from_ros(value: Any) -> Value:
    """Lists, tuples and arrays become tuples."""
    return value if isinstance(value, bool | int | float | str) else tuple(value)


def _descriptor(spec: ParameterSpec) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        description=spec.description,
        additional_constraints=choices_text(spec.choices),
        read_only=spec.read_only,
    )
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
