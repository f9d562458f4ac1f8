"""What a gate listens to and publishes on must be different topics, one for each robot."""

from __future__ import annotations

from collections.abc import Sequence

from crash_coach_common.contract import UserError


def check_wiring(
    robots: Sequence[str],
    inputs: Sequence[str],
    outputs: Sequence[str],
    names: tuple[str, str] = ("raw_topic", "command_topic"),
) -> None:
    """Holds a gate's resolved topics, one for each robot, against each other.

    Args:
        robots: their names, in order.
        inputs: the topic that is relayed, of each robot.
        outputs: the topic that it is relayed to, of each robot.
        names: how inputs and outputs are called.

    Raises:
        UserError: two robots share a topic, or the gate would relay what it publishes itself.
    """
    for name, topics in zip(names, (inputs, outputs), strict=True):
        for index, topic in enumerate(topics):
            first = topics.index(topic)
            if first != index:
                raise UserError(
                    f"{name}: {robots[first]} and {robots[index]} would share {topic}; a topic for "
                    "each robot is needed: a name without a leading '/' is one within each robot's "
                    "namespace, an absolute one is for a gate of one robot"
                )
    for robot, topic in zip(robots, inputs, strict=True):
        if topic in outputs:
            raise UserError(
                f"the gate would feed itself: it would listen for {robot} on {topic} and publish "
                f"there as well; {names[0]} and {names[1]} have to be different topics, after "
                "remapping too"
            )
