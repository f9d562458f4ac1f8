"""The node behind both executables: an Agent between observation and command topics."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial

import rclpy
from crash_coach_interfaces.msg import Action, Observation
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.context import Context
from rclpy.exceptions import ParameterException
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from sim_pkg.contract import UserError
from std_msgs.msg import Header

from policy_pkg.act import greedy
from policy_pkg.agent import Agent
from policy_pkg.checkpoint import load_policy
from policy_pkg.ros.convert import message_from_answer, sensed_from_message

NEWEST = QoSProfile(depth=1)  # reliable: an observation or command replaces the one before
SPIN_S = 0.1  # how soon a signal is noticed


class AgentNode(Node):
    """Subscribes /<robot>/observation and publishes /<robot>/<command_topic> for its robots.

    Raises:
        UserError: a parameter is missing, unknown or wrong (CheckpointError for the checkpoint).
    """

    def __init__(self, name: str, one_robot: bool, context: Context | None = None) -> None:
        super().__init__(name, context=context)
        robot = self._text("robot", "robot that this policy drives") if one_robot else None
        checkpoint = self._text("checkpoint", "run directory or checkpoint directory")
        command_topic = self._text(
            "command_topic", "topic under /<robot>/ for the answers", "command_raw"
        )
        self._refuse_unknown_parameters()
        bundle = load_policy(checkpoint)
        self.agent: Agent[Header] = Agent(
            bundle.policy,
            bundle.robots,
            bundle.robots if robot is None else (robot,),
            bundle.obs_size,
            bundle.n_actions,
            greedy,
        )
        self._commands = [
            self.create_publisher(Action, f"/{name}/{command_topic}", NEWEST)
            for name in self.agent.robots
        ]
        for index, name in enumerate(self.agent.robots):
            self.create_subscription(
                Observation, f"/{name}/observation", partial(self._on_observation, index), NEWEST
            )

    def _text(self, name: str, description: str, default: str = "") -> str:
        value: str = self.declare_parameter(
            name, default, ParameterDescriptor(description=description, read_only=True)
        ).value
        if not value:
            raise UserError(f"parameter {name!r} of {self.get_name()} is missing: {description}")
        return value

    def _refuse_unknown_parameters(self) -> None:
        for name in self._parameter_overrides:
            if not self.has_parameter(name):
                known = ", ".join(sorted(self._parameters))
                raise UserError(f"unknown parameter {name!r} of {self.get_name()}; known: {known}")

    def _on_observation(self, robot: int, message: Observation) -> None:
        for answer in self.agent.receive(robot, sensed_from_message(message)):
            self._commands[answer.robot].publish(message_from_answer(answer))


def spin(make_node: Callable[[], Node]) -> int:
    """Runs a node until SIGINT or SIGTERM; returns the exit code, 1 after one line of error."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.ALL)
    try:
        node = make_node()
        executor = EventsExecutor()
        executor.add_node(node)
        while rclpy.ok():
            executor.spin_once(timeout_sec=SPIN_S)
    except (UserError, ParameterException) as error:
        print(f"{sys.argv[0].rpartition('/')[2]}: error: {error}", file=sys.stderr)  # noqa: T201
        return 1
    finally:
        rclpy.try_shutdown()
    return 0
