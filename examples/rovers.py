"""Two robots that Crash Coach does not simulate, and their controllers: a stand-in for yours.

    python examples/rovers.py

Each controller wants 0.2 m/s, twenty times a second, on /<rover>/cmd_vel_raw. Each rover listens to
/<rover>/cmd_vel alone, says how fast it drives whenever that changes, and stops where no command
came for half a second. Without a gate between the two nobody drives.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial

import rclpy
from geometry_msgs.msg import Twist
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

ROVERS = ("rover_1", "rover_2")
WANTED_M_S, PERIOD_S, WATCHDOG_S = 0.2, 0.05, 0.5


class Rovers(Node):
    def __init__(self, clock_s: Callable[[], float]) -> None:
        super().__init__("rovers")
        self._clock_s = clock_s
        self._heard_s = dict.fromkeys(ROVERS, -math.inf)
        self._speed_m_s = dict.fromkeys(ROVERS, 0.0)
        self._controllers = []
        for name in ROVERS:
            self._controllers.append(self.create_publisher(Twist, f"{name}/cmd_vel_raw", 10))
            self.create_subscription(Twist, f"{name}/cmd_vel", partial(self._on_command, name), 10)
            print(f"{name} stands", flush=True)
        self.create_timer(PERIOD_S, self._on_timer)

    def _on_command(self, name: str, message: Twist) -> None:
        self._heard_s[name] = self._clock_s()
        self._drive(name, message.linear.x)

    def _on_timer(self) -> None:
        wanted = Twist()
        wanted.linear.x = WANTED_M_S
        for controller in self._controllers:
            controller.publish(wanted)
        for name, heard_s in self._heard_s.items():
            if self._clock_s() - heard_s > WATCHDOG_S:
                self._drive(name, 0.0)

    def _drive(self, name: str, speed_m_s: float) -> None:
        if speed_m_s != self._speed_m_s[name]:
            self._speed_m_s[name] = speed_m_s
            how = f"drives at {speed_m_s:g} m/s" if speed_m_s else "stands"
            print(f"{name} {how}", flush=True)


def main() -> None:
    rclpy.init()
    try:
        rclpy.spin(Rovers(time.monotonic))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
