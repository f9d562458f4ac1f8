"""Commands of robots that this project does not simulate: serialized messages of any type.

Nothing is parsed unless a fault in force asks for it. Which faults a type can have depends on
what is known of it: Twist and TwistStamped have velocities to draw and to change.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.serialization import deserialize_message, serialize_message

from crash_coach_common.contract import UserError
from crash_coach_common.keyed_random import random_bits
from crash_coach_pkg.faults.base import Need, Vector

_LINEAR_X, _LINEAR_Y, _ANGULAR_Z = 0, 1, 5  # places in a vector


@dataclass(frozen=True)
class Limits:
    """Of a random command: uniform between plus and minus of each; other velocities are 0."""

    linear_x_m_s: float
    linear_y_m_s: float
    angular_z_rad_s: float


class OpaqueTools:
    """Of a type that nothing is known of: any command may be passed on at any time."""

    def usable(self, command: bytes) -> bool:
        return True

    def sample(self, bits: int) -> bytes | None:
        return None

    def worst(self) -> bytes | None:
        return None

    def vector(self, command: bytes) -> Vector:
        raise TypeError("a command of this type has no velocities")

    def with_vector(self, command: bytes, vector: Vector) -> bytes:
        raise TypeError("a command of this type has no velocities")


class TwistTools(OpaqueTools):
    """Of Twist, or of a message that holds one.

    Args:
        command: the newest command; a random one has its header.
        twist_of: the Twist within a message.
    """

    def __init__(
        self, type_: type, twist_of: Callable[[Any], Twist], limits: Limits, command: bytes
    ) -> None:
        self._type = type_
        self._twist_of = twist_of
        self._limits = limits
        self._command = command

    def sample(self, bits: int) -> bytes | None:
        vector = np.zeros(6)
        limits = self._limits
        for place, limit in (
            (_LINEAR_X, limits.linear_x_m_s),
            (_LINEAR_Y, limits.linear_y_m_s),
            (_ANGULAR_Z, limits.angular_z_rad_s),
        ):
            uniform = (int(random_bits(bits, 0, 0, place)[0]) >> 11) * 2.0**-53
            vector[place] = (2.0 * uniform - 1.0) * limit
        return self.with_vector(self._command, vector)

    def vector(self, command: bytes) -> Vector:
        twist = self._twist_of(deserialize_message(command, self._type))
        return np.array(
            [
                twist.linear.x, twist.linear.y, twist.linear.z,
                twist.angular.x, twist.angular.y, twist.angular.z,
            ]
        )  # fmt: skip

    def with_vector(self, command: bytes, vector: Vector) -> bytes:
        message = deserialize_message(command, self._type)
        twist = self._twist_of(message)
        twist.linear.x, twist.linear.y, twist.linear.z = (float(v) for v in vector[:3])
        twist.angular.x, twist.angular.y, twist.angular.z = (float(v) for v in vector[3:])
        data: bytes = serialize_message(message)
        return data


@dataclass(frozen=True)
class CommandType:
    """A message type, and what faults can do with its commands."""

    name: str
    message: type
    offers: frozenset[Need]
    tools: Callable[[bytes], OpaqueTools]
    """Tools for the step in which this is the newest command."""


def command_type(name: str, limits: Limits) -> CommandType:
    """The type called ``package/msg/Type``.

    Raises:
        UserError: no such package or type is installed.
    """
    message = _message_type(name)
    twist_of = {Twist: _itself, TwistStamped: _within}.get(message)
    if twist_of is None:
        return CommandType(
            name, message, frozenset(("availability",)), lambda command: OpaqueTools()
        )
    return CommandType(
        name,
        message,
        frozenset(("availability", "sampler", "vector")),
        lambda command: TwistTools(message, twist_of, limits, command),
    )


def _itself(message: Twist) -> Twist:
    return message


def _within(message: TwistStamped) -> Twist:
    return message.twist


def _message_type(name: str) -> type:
    parts = name.split("/")
    if len(parts) != 3 or parts[1] != "msg" or not all(part.isidentifier() for part in parts):
        raise UserError(
            f"parameter command_type = {name!r}: not of the form package/msg/Type, such as "
            "geometry_msgs/msg/Twist; nor is it auto"
        )
    package, _, type_name = parts
    try:
        module = importlib.import_module(f"{package}.msg")
    except ImportError as error:
        raise UserError(
            f"parameter command_type = {name!r}: package {package!r} cannot be loaded ({error}); "
            "is its workspace sourced?"
        ) from None
    found = getattr(module, type_name, None)
    if not isinstance(found, type):
        raise UserError(
            f"parameter command_type = {name!r}: package {package!r} has no message {type_name!r}"
        )
    return found
