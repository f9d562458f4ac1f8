"""A gate's topics, one of each kind for every robot: their names, and who is at the other end."""

from __future__ import annotations

from collections.abc import Sequence

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.exceptions import NameValidationException
from rclpy.node import Node

from crash_coach_common.contract import UserError
from crash_coach_common.ros.run_node import RCLError
from crash_coach_pkg.gate.wiring import check_wiring
from crash_coach_pkg.ros.endpoints import strangers


class RobotTopics:
    """Parameters: raw_topic, command_topic, robot_namespaces.

    ``raw`` and ``commands``: what the gate relays, and to where, of each robot, as written:
    rclpy still applies the node's namespace and remapping, as to every name. ``raw_name`` and
    ``command_name``: the parameters.

    Raises:
        UserError: a name that is none, not one namespace for each robot, two robots that share a
            topic, or a gate that would relay what it publishes itself.
    """

    def __init__(self, node: Node, robots: Sequence[str], defaults: tuple[str, str]) -> None:
        self._node = node
        self._robots = robots
        self._namespaces = self._declare_namespaces()
        about = "within each robot's namespace; with a leading '/' this very topic"
        self.raw_name, self.raw = self._declare(
            "raw_topic", defaults[0], f"What is relayed, {about}."
        )
        self.command_name, self.commands = self._declare(
            "command_topic", defaults[1], f"Where it is relayed to, {about}."
        )
        check_wiring(robots, self._resolved(self.raw), self._resolved(self.commands))
        self._told: dict[tuple[int, bool], str] = {}

    def within(self, name: str) -> list[str]:
        """``name`` in each robot's namespace."""
        return [f"{space}/{name}" if space else name for space in self._namespaces]

    def check(self, inputs: str, outputs: str) -> None:
        """Of another pair that is relayed. Raises UserError as the constructor."""
        pair = self._resolved(self.within(inputs)), self._resolved(self.within(outputs))
        check_wiring(self._robots, *pair, (inputs, outputs))

    def wrong_publishers(self, robot: int, type_name: str) -> str:
        """Who publishes another type than ``type_name`` for the robot; empty: nobody.

        What is new is logged as an error, since nothing of it can reach the robot.
        """
        return self._strangers(robot, self.raw[robot], type_name, listening=False)

    def wrong_listeners(self, robot: int, type_name: str) -> str:
        """Who listens for another type than ``type_name`` to the robot's commands; as above."""
        return self._strangers(robot, self.commands[robot], type_name, listening=True)

    def _strangers(self, robot: int, topic: str, type_name: str, listening: bool) -> str:
        found = strangers(self._node, topic, type_name, listening)
        shown = self._node.resolve_topic_name(topic)
        does, here = ("listens for", "publishes") if listening else ("publishes", "relays")
        text = "; ".join(
            f"{who.node} {does} {who.type_name} on {shown}, but this gate {here} {type_name} "
            "(command_type)"
            for who in found
        )
        if text and self._told.get((robot, listening)) != text:
            self._node.get_logger().error(text)
        self._told[robot, listening] = text
        return text

    def _declare(self, parameter: str, default: str, description: str) -> tuple[str, list[str]]:
        descriptor = ParameterDescriptor(description=description, read_only=True)
        name: str = self._node.declare_parameter(parameter, default, descriptor).value
        if not name.strip("/"):
            raise UserError(f"parameter {parameter} = {name!r} names no topic")
        topics = [name] * len(self._robots) if name.startswith("/") else self.within(name)
        try:
            for topic in topics:
                self._node.resolve_topic_name(topic)
        except (NameValidationException, RCLError) as error:
            reason = str(error).splitlines()[0].split(", at /")[0]
            raise UserError(f"parameter {parameter} = {name!r}: {reason}") from None
        return name, topics

    def _declare_namespaces(self) -> list[str]:
        descriptor = ParameterDescriptor(
            description="Namespace of each robot's topics, in the order of robots, within this "
            "node's namespace or, with a leading '/', absolute; [''] for one robot that has none.",
            read_only=True,
        )
        default = list(self._robots)
        given = self._node.declare_parameter("robot_namespaces", default, descriptor).value
        spaces = [space if space == "/" else space.rstrip("/") for space in given]
        if len(spaces) != len(self._robots):
            raise UserError(
                f"robot_namespaces {list(given)}: {len(spaces)} for {len(self._robots)} robots; "
                "one for each robot is needed"
            )
        return ["" if space == "/" else space for space in spaces]

    def _resolved(self, topics: Sequence[str]) -> list[str]:
        return [self._node.resolve_topic_name(topic) for topic in topics]
