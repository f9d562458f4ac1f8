"""A robot that this project does not simulate: a differential drive that listens to Twist only.

Run one as a process: ``python fleet.py NAME``.
"""

from __future__ import annotations

import math
import signal
import sys
import time

import rclpy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

PERIOD_S = 0.05
WATCHDOG_S = 0.5


class DifferentialDrive(Node):
    """A unicycle: /<name>/cmd_vel drives it, /<name>/odom says where it is; it stops untold."""

    def __init__(self, name: str) -> None:
        super().__init__("base", namespace=name, use_global_arguments=False)
        self._x_m = self._y_m = self._heading_rad = 0.0
        self._v_m_s = self._w_rad_s = 0.0
        self._heard_s = -math.inf
        self._odom = self.create_publisher(Odometry, "odom", 10)
        self.create_subscription(Twist, "cmd_vel", self._on_command, 10)
        self.create_timer(PERIOD_S, self._on_timer, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _on_command(self, message: Twist) -> None:
        self._v_m_s, self._w_rad_s = message.linear.x, message.angular.z
        self._heard_s = time.monotonic()

    def _on_timer(self) -> None:
        if time.monotonic() - self._heard_s > WATCHDOG_S:
            self._v_m_s = self._w_rad_s = 0.0
        self._heading_rad += self._w_rad_s * PERIOD_S
        self._x_m += self._v_m_s * math.cos(self._heading_rad) * PERIOD_S
        self._y_m += self._v_m_s * math.sin(self._heading_rad) * PERIOD_S
        message = Odometry()
        message.pose.pose.position.x, message.pose.pose.position.y = self._x_m, self._y_m
        message.pose.pose.orientation.z = math.sin(self._heading_rad / 2)
        message.pose.pose.orientation.w = math.cos(self._heading_rad / 2)
        message.twist.twist.linear.x = self._v_m_s
        message.twist.twist.angular.z = self._w_rad_s
        self._odom.publish(message)


def main() -> None:
    stopped: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda n, _: stopped.append(n))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = DifferentialDrive(sys.argv[1])
    executor = EventsExecutor()
    executor.add_node(node)
    while not stopped:
        executor.spin_once(timeout_sec=0.1)
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
