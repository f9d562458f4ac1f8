"""Commands of robots that this project does not simulate: serialized messages of any type.

Nothing is parsed unless a fault in force asks for it. Which faults a type can have depends on
what is known of it: Twist and TwistStamped have velocities to draw and to change.
"""

from __future__ import annotations

import importlib
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.serialization import deserialize_message, serialize_message

from crash_coach_common.contract import UserError
from crash_coach_common.keyed_random import bits_of_one
from crash_coach_pkg.faults.base import Need, Vector

_LINEAR_X, _LINEAR_Y, _ANGULAR_Z = 0, 1, 5  # places in a vector
_ENCAPSULATION, _VELOCITIES = 4, 6
_HEAD = struct.Struct("<8xI"), struct.Struct(">8xI")  # a header's stamp, length of its frame_id
_TWIST = struct.Struct("<6d"), struct.Struct(">6d")


@dataclass(frozen=True)
class Limits:
    """Of faulted commands, plus and minus: a random one is uniform between them, its other
    velocities 0; a changed one stays within them, or within what was commanded where that is more.
    """

    linear_x_m_s: float
    linear_y_m_s: float
    angular_z_rad_s: float

    def vector(self) -> Vector:
        """(6,); infinite where there is none."""
        limits = np.full(_VELOCITIES, math.inf)
        limits[[_LINEAR_X, _LINEAR_Y, _ANGULAR_Z]] = (
            self.linear_x_m_s, self.linear_y_m_s, self.angular_z_rad_s,
        )  # fmt: skip
        return limits


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

    def with_vector(self, command: bytes, vector: Vector) -> bytes | None:
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
        vector = np.zeros(_VELOCITIES)
        limits = self._limits.vector()
        for place in (_LINEAR_X, _LINEAR_Y, _ANGULAR_Z):
            uniform = (bits_of_one(bits, 0, 0, place) >> 11) * 2.0**-53
            vector[place] = (2.0 * uniform - 1.0) * limits[place]
        return self._made(self._command, vector)

    def vector(self, command: bytes) -> Vector:
        twist = self._twist_of(deserialize_message(command, self._type))
        return np.array(
            [
                twist.linear.x, twist.linear.y, twist.linear.z,
                twist.angular.x, twist.angular.y, twist.angular.z,
            ]
        )  # fmt: skip

    def with_vector(self, command: bytes, vector: Vector) -> bytes | None:
        """None where a velocity is not finite. A fault takes no velocity beyond its limit, unless
        the controller, which knows its robot, wants more."""
        bounds = np.maximum(self._limits.vector(), np.abs(self.vector(command)))
        if not np.isfinite(vector).all() or np.isnan(bounds).any():
            return None
        return self._made(command, np.clip(vector, -bounds, bounds))

    def _made(self, command: bytes, vector: Vector) -> bytes:
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
    finite: Callable[[bytes], bool]
    """Whether a command's velocities are all finite, without a message object; True where the type
    has none."""


def command_type(name: str, limits: Limits) -> CommandType:
    """The type called ``package/msg/Type``.

    Raises:
        UserError: no such package or type is installed.
    """
    message = _message_type(name)
    twist_of = {Twist: _itself, TwistStamped: _within}.get(message)
    if twist_of is None:
        return CommandType(
            name,
            message,
            frozenset(("availability",)),
            lambda command: OpaqueTools(),
            lambda command: True,
        )
    return CommandType(
        name,
        message,
        frozenset(("availability", "sampler", "vector")),
        lambda command: TwistTools(message, twist_of, limits, command),
        _finite_twist if message is Twist else _finite_stamped,
    )


def _finite_twist(command: bytes, start: int = _ENCAPSULATION) -> bool:
    """A serialized Twist that begins at ``start``; one that is cut short has no finite velocity."""
    if len(command) < start + _TWIST[0].size:
        return False
    return all(map(math.isfinite, _TWIST[_big_endian(command)].unpack_from(command, start)))


def _finite_stamped(command: bytes) -> bool:
    """A serialized TwistStamped: behind the header, at a multiple of 8 of the body."""
    head = _HEAD[_big_endian(command)]
    if len(command) < _ENCAPSULATION + head.size:
        return False
    end = head.size + head.unpack_from(command, _ENCAPSULATION)[0]
    return _finite_twist(command, _ENCAPSULATION + end + -end % 8)


def _big_endian(command: bytes) -> bool:
    """As the encapsulation says."""
    return len(command) > 1 and command[1] % 2 == 0


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
