"""Random names, types and values for the parameter services of a node, and what must hold."""

from __future__ import annotations

import math
import random
import string
import time
from collections.abc import Callable, Sequence
from typing import Any

from rcl_interfaces.msg import Parameter, ParameterDescriptor, ParameterType, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.executors import Executor
from rclpy.node import Node

WAIT_S = 60.0
FIELDS = {
    ParameterType.PARAMETER_BOOL: "bool_value",
    ParameterType.PARAMETER_INTEGER: "integer_value",
    ParameterType.PARAMETER_DOUBLE: "double_value",
    ParameterType.PARAMETER_STRING: "string_value",
    ParameterType.PARAMETER_BYTE_ARRAY: "byte_array_value",
    ParameterType.PARAMETER_BOOL_ARRAY: "bool_array_value",
    ParameterType.PARAMETER_INTEGER_ARRAY: "integer_array_value",
    ParameterType.PARAMETER_DOUBLE_ARRAY: "double_array_value",
    ParameterType.PARAMETER_STRING_ARRAY: "string_array_value",
}
ARRAYS = {6: 1, 7: 2, 8: 3, 9: 4}  # and the type of what is in them
INTEGERS = (0, 1, 2, 3, 5, -1, -2, 100, 2**31, 2**32 - 1, 2**32, 2**63 - 1, -(2**63))
DOUBLES = (0.0, 1.0, 0.5, 0.1, 2.0, -1.0, -0.5, 60.0, 1e-300, 1e300, math.inf, -math.inf, math.nan)


def python(value: ParameterValue) -> object:
    """Type and value; equal where the parameters are, NaN included."""
    if value.type not in FIELDS:
        return (value.type,)
    held = getattr(value, FIELDS[value.type])
    items = held if isinstance(held, bool | int | float | str) else list(held)
    return (value.type, repr(items))


class Fuzzer:
    """Calls the parameter services of ``target`` from ``node``, which is on ``executor``.

    ``words``: strings that mean something to it. ``alive`` fails where it has ended.
    """

    def __init__(
        self,
        node: Node,
        executor: Executor,
        target: str,
        words: Sequence[str],
        alive: Callable[[], None],
        seed: int,
    ) -> None:
        self._executor = executor
        self._words = words
        self._alive = alive
        self._rng = random.Random(seed)

        def client(service: type, name: str) -> Any:
            return node.create_client(service, f"{target}/{name}")

        self._list = client(ListParameters, "list_parameters")
        self._describe = client(DescribeParameters, "describe_parameters")
        self._get = client(GetParameters, "get_parameters")
        self._set = client(SetParameters, "set_parameters")
        self._set_all = client(SetParametersAtomically, "set_parameters_atomically")
        self._await(lambda: all(c.service_is_ready() for c in (self._list, self._get, self._set)))
        self._await(lambda: self._set_all.service_is_ready() and self._describe.service_is_ready())
        listed = self._call(self._list, ListParameters.Request())
        self.names: list[str] = list(listed.result.names)
        described = self._call(self._describe, DescribeParameters.Request(names=self.names))
        self._descriptors: dict[str, ParameterDescriptor] = {
            d.name: d for d in described.descriptors
        }
        self.applied = 0
        self.refused = 0

    def _await(self, done: Callable[[], bool]) -> None:
        end = time.monotonic() + WAIT_S
        while not done():
            self._alive()
            assert time.monotonic() < end, "the node does not answer"
            self._executor.spin_once(timeout_sec=0.05)

    def _call(self, client: Any, request: Any) -> Any:
        future = client.call_async(request)
        self._await(future.done)
        return future.result()

    def values(self) -> dict[str, ParameterValue]:
        answer = self._call(self._get, GetParameters.Request(names=self.names))
        return dict(zip(self.names, answer.values, strict=True))

    def once(self) -> dict[str, ParameterValue]:
        """One call. What was refused must be unchanged, what was not must be as asked; returns
        every value after it."""
        before = {name: python(value) for name, value in self.values().items()}
        asked = [self._parameter() for _ in range(self._rng.choice((1, 1, 2, 3, 5)))]
        if self._rng.random() < 0.6:
            request = SetParametersAtomically.Request(parameters=asked)
            results = [self._call(self._set_all, request).result]
            changes = [asked]
        else:
            results = self._call(self._set, SetParameters.Request(parameters=asked)).results
            changes = [[one] for one in asked]
        expected = dict(before)
        for result, change in zip(results, changes, strict=True):
            if result.successful:
                self.applied += 1
                expected |= {one.name: python(one.value) for one in change}
            else:
                self.refused += 1
                assert result.reason, change
        after = self.values()
        assert {name: python(value) for name, value in after.items()} == expected, asked
        return after

    def _parameter(self) -> Parameter:
        rng = self._rng
        if rng.random() < 0.1:
            return Parameter(name=self._odd_name(), value=self._value(rng.randrange(10)))
        name = rng.choice(self.names)
        kind = self._descriptors[name].type if rng.random() < 0.8 else rng.randrange(14)
        return Parameter(name=name, value=self._value(kind, self._descriptors[name]))

    def _odd_name(self) -> str:
        rng = self._rng
        known = rng.choice(self.names)
        return rng.choice(
            ("", known + "x", known.upper(), f"{known}.{known}", "ü\u2603", "a b", "x" * 5000,
             "".join(rng.choices(string.printable, k=8)), "qos_overrides./x.depth"),
        )  # fmt: skip

    def _value(self, kind: int, about: ParameterDescriptor | None = None) -> ParameterValue:
        value = ParameterValue(type=kind)
        if kind in ARRAYS:
            items = [
                self._scalar(ARRAYS[kind], None) for _ in range(self._rng.choice((0, 1, 2, 3)))
            ]
            setattr(value, FIELDS[kind], items)
        elif kind == ParameterType.PARAMETER_BYTE_ARRAY:
            value.byte_array_value = [bytes([b]) for b in self._rng.randbytes(3)]
        elif kind in FIELDS:
            setattr(value, FIELDS[kind], self._scalar(kind, about))
        return value

    def _scalar(self, kind: int, about: ParameterDescriptor | None) -> Any:
        rng = self._rng
        sensible = rng.random() < 0.7
        if kind == ParameterType.PARAMETER_BOOL:
            return rng.random() < 0.7
        if kind == ParameterType.PARAMETER_INTEGER:
            if sensible and about is not None and about.integer_range:
                limits = about.integer_range[0]
                return rng.randint(limits.from_value, min(limits.to_value, limits.from_value + 4))
            return rng.choice(INTEGERS)
        if kind == ParameterType.PARAMETER_DOUBLE:
            if sensible and about is not None and about.floating_point_range:
                limits = about.floating_point_range[0]
                return rng.uniform(limits.from_value, limits.to_value)
            return rng.choice(DOUBLES)
        if sensible:
            return rng.choice(self._words)
        return rng.choice(("", " ", "Mute", "\u2603", "x" * 10_000, "[1, 2]", "nan"))
