"""Serialized messages to and from the agent's types.

Observations and commands stay in the form in which they travel: making Python message objects
of them took more than half of a policy node's time. The layout is plain little-endian CDR
(OMG DDS-RTPS 2.5, section 10; XCDR version 1), which every RMW of ROS 2 uses on this hardware;
tests hold it against rclpy's own serialization.
"""

from __future__ import annotations

import struct

import numpy as np

from crash_coach_common.contract import UserError
from policy_pkg.agent import Answer, Sensed

# Encapsulation (4 bytes), stamp (8), length of frame_id (4), frame_id, padding to 4.
_ENCAPSULATION = b"\x00\x01"
_FRAME_ID_LENGTH = struct.Struct("<I")
_FRAME_ID_AT = 16
_OBSERVED = struct.Struct("<IIiI")  # episode, step, last_action, number of features
_COUNT = struct.Struct("<I")
_COMMANDED = struct.Struct("<IIiiB")  # episode, step, action, worst_action, fault


def sensed_from_bytes(data: bytes) -> Sensed[bytes]:
    """A crash_coach_interfaces/Observation. Its arrays are views; its stamp is the whole header.

    Raises:
        UserError: not little-endian CDR, or shorter than it says.
    """
    if data[:2] != _ENCAPSULATION:
        raise UserError(f"observation: encapsulation {data[:2].hex()} is not little-endian CDR")
    try:
        (length,) = _FRAME_ID_LENGTH.unpack_from(data, _FRAME_ID_AT - 4)
        start = _FRAME_ID_AT + (length + 3 & ~3)
        episode, step, last_action, n_features = _OBSERVED.unpack_from(data, start)
        features_at = start + _OBSERVED.size
        count_at = features_at + 4 * n_features
        (n_actions,) = _COUNT.unpack_from(data, count_at)
        features = np.frombuffer(data, np.float32, n_features, features_at)
        available = np.frombuffer(data, np.uint8, n_actions, count_at + 4)
    except (struct.error, ValueError) as error:
        raise UserError(f"observation of {len(data)} bytes is cut short: {error}") from error
    return Sensed(episode, step, last_action, features, available, data[:start])


def bytes_from_answer(answer: Answer[bytes]) -> bytes:
    """A crash_coach_interfaces/Action with the header of the observation that it answers."""
    return answer.stamp + _COMMANDED.pack(
        answer.episode, answer.step, answer.action, answer.worst_action, 0
    )


def fault_from_bytes(data: bytes) -> tuple[int, int]:
    """(action, fault) of a crash_coach_interfaces/Action.

    Raises:
        UserError: shorter than it says.
    """
    try:
        (length,) = _FRAME_ID_LENGTH.unpack_from(data, _FRAME_ID_AT - 4)
        fields = _COMMANDED.unpack_from(data, _FRAME_ID_AT + (length + 3 & ~3))
    except struct.error as error:
        raise UserError(f"command of {len(data)} bytes is cut short: {error}") from error
    return fields[2], fields[4]
