"""Serialized messages that are read and written without message objects.

Plain little-endian CDR (OMG DDS-RTPS 2.5, section 10; XCDR version 1), which every RMW of ROS 2
uses on this hardware; tests hold what is read and written against rclpy's own serialization.
"""

from __future__ import annotations

import struct

from crash_coach_common.contract import UserError

LITTLE_ENDIAN = b"\x00\x01"
ENCAPSULATION_SIZE = 4
COUNT = struct.Struct("<I")  # of a string's bytes or a sequence's items
FRAME_ID_AT = 16  # behind the encapsulation (4 bytes), the stamp (8), the length of frame_id (4)
COMMANDED = struct.Struct("<IIiiB")  # an Action's episode, step, action, worst_action, fault
OBSERVED = struct.Struct("<IIi")  # an Observation's episode, step, last_action


def body_at(what: str, data: bytes) -> int:
    """Where the fields behind a message's header begin.

    Raises:
        UserError: not little-endian CDR, or cut short; calls the message ``what``.
    """
    if data[:2] != LITTLE_ENDIAN:
        raise UserError(f"{what}: encapsulation {data[:2].hex()} is not little-endian CDR")
    try:
        (length,) = COUNT.unpack_from(data, FRAME_ID_AT - COUNT.size)
    except struct.error as error:
        raise cut_short(what, data, error) from error
    start: int = FRAME_ID_AT + (length + 3 & ~3)
    return start


def cut_short(what: str, data: bytes, error: Exception) -> UserError:
    """To be raised where a field lies behind the end of the message."""
    return UserError(f"{what} of {len(data)} bytes is cut short: {error}")
