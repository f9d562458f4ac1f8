"""Messages to and from the agent's types."""

from __future__ import annotations

import numpy as np
from crash_coach_interfaces.msg import Action, Observation
from std_msgs.msg import Header

from policy_pkg.agent import Answer, Sensed


def sensed_from_message(message: Observation) -> Sensed[Header]:
    """The arrays are views of the message's memory."""
    return Sensed(
        message.episode,
        message.step,
        message.last_action,
        np.frombuffer(message.features, dtype=np.float32),
        np.frombuffer(message.available_actions, dtype=np.uint8),
        message.header,
    )


def message_from_answer(answer: Answer[Header]) -> Action:
    """The command carries the header of the observation that it answers."""
    return Action(
        header=answer.stamp, episode=answer.episode, step=answer.step, action=answer.action
    )
