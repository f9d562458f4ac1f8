"""Sets the coach's parameters from a node of its own, as an operator would."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from std_srvs.srv import Trigger

from crash_coach_bringup.ros.client import greet

WAIT_S = 60.0


def close(executor: EventsExecutor, node: Node, context: Context) -> None:
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown(context=context)


class Operator:
    """Sets the coach's parameters from a context and node of its own."""

    def __init__(self, domain: int) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node("test_operator", context=self.context)
        self.executor = EventsExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.parameters = AsyncParameterClient(self.node, "/coach")
        self.clearing = self.node.create_client(Trigger, "/coach/clear_all")
        greet(self.node, "/coach", self.executor.spin_once, WAIT_S, "/coach")
        end = time.monotonic() + WAIT_S
        while not (self.parameters.services_are_ready() and self.clearing.service_is_ready()):
            assert time.monotonic() < end, "no /coach"
            self.executor.spin_once(timeout_sec=0.05)

    def close(self) -> None:
        close(self.executor, self.node, self.context)

    def _result(self, future: Any) -> Any:
        end = time.monotonic() + WAIT_S
        while not future.done():
            assert time.monotonic() < end, "the coach does not answer"
            self.executor.spin_once(timeout_sec=0.05)
        return future.result()

    def set(self, **values: object) -> str:
        """All at once; returns the reason of a refusal, or nothing."""
        parameters = [Parameter(name, value=value) for name, value in values.items()]
        answer = self._result(self.parameters.set_parameters_atomically(parameters)).result
        assert answer.successful or answer.reason, "refused without a reason"
        return "" if answer.successful else str(answer.reason)

    def begin(self, **values: object) -> Any:
        """As ``set``, without waiting: the call's future, for ``poll``."""
        parameters = [Parameter(name, value=value) for name, value in values.items()]
        return self.parameters.set_parameters_atomically(parameters)

    def poll(self, future: Any) -> bool:
        """Serves the node a little; whether there is an answer."""
        self.executor.spin_once(timeout_sec=0)
        return bool(future.done())

    def get(self, *names: str) -> Sequence[object]:
        values = self._result(self.parameters.get_parameters(list(names))).values
        return [parameter_value_to_python(value) for value in values]

    def names(self) -> Sequence[str]:
        return self._result(self.parameters.list_parameters([], 0)).result.names  # type: ignore[no-any-return]

    def load(self, path: str) -> Sequence[Any]:
        """What `ros2 param load` calls; a result for each parameter of the file."""
        return self._result(self.parameters.load_parameter_file(path)).results  # type: ignore[no-any-return]

    def describe(self, names: Sequence[str]) -> Sequence[Any]:
        return tuple(self._result(self.parameters.describe_parameters(list(names))).descriptors)

    def clear(self) -> Trigger.Response:
        return self._result(self.clearing.call_async(Trigger.Request()))
