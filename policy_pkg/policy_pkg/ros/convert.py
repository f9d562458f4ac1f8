"""Serialized messages to and from the agent's types.

Observations and commands stay in the form in which they travel: making Python message objects
of them took more than half of a policy node's time; see crash_coach_common.cdr.
"""

from __future__ import annotations

import struct

import numpy as np

from crash_coach_common.cdr import COMMANDED, COUNT, OBSERVED, body_at, cut_short
from policy_pkg.agent import Answer, Sensed


def sensed_from_bytes(data: bytes) -> Sensed[bytes]:
    """A crash_coach_interfaces/Observation. Its arrays are views; its stamp is the whole header.

    Raises:
        UserError: not little-endian CDR, or shorter than it says.
    """
    start = body_at("observation", data)
    try:
        episode, step, last_action = OBSERVED.unpack_from(data, start)
        (n_features,) = COUNT.unpack_from(data, start + OBSERVED.size)
        features_at = start + OBSERVED.size + COUNT.size
        count_at = features_at + 4 * n_features
        (n_actions,) = COUNT.unpack_from(data, count_at)
        features = np.frombuffer(data, np.float32, n_features, features_at)
        available = np.frombuffer(data, np.uint8, n_actions, count_at + 4)
    except (struct.error, ValueError) as error:
        raise cut_short("observation", data, error) from error
    return Sensed(episode, step, last_action, features, available, data[:start])


def bytes_from_answer(answer: Answer[bytes]) -> bytes:
    """A crash_coach_interfaces/Action with the header of the observation that it answers."""
    return answer.stamp + COMMANDED.pack(
        answer.episode, answer.step, answer.action, answer.worst_action, 0
    )


def fault_from_bytes(data: bytes) -> tuple[int, int]:
    """(action, fault) of a crash_coach_interfaces/Action.

    Raises:
        UserError: not little-endian CDR, or shorter than it says.
    """
    start = body_at("command", data)
    try:
        fields = COMMANDED.unpack_from(data, start)
    except struct.error as error:
        raise cut_short("command", data, error) from error
    return fields[2], fields[4]
