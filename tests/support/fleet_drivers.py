"""Plain publishers that drive the fleet at 20 Hz, and everything there is to see of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial

import rclpy
from coach_operator import WAIT_S, close
from crash_coach_interfaces.msg import FaultEvent
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy

ROVERS = ("rover_1", "rover_2", "rover_3")
BEST_EFFORT = "rover_3"
PERIOD_S = 0.05
SPEED_M_S = 0.2
TURN_RAD_S = 0.1


class Drivers(threading.Thread):
    """Drives every rover with numbered commands (linear.z is the number), in a thread.

    ``sent`` and ``got``: of each rover, (number, time) in order; ``commands``: what it got.
    """

    def __init__(self, domain: int) -> None:
        super().__init__(name="drivers")
        self.sent: dict[str, list[tuple[int, float]]] = {name: [] for name in ROVERS}
        self.got: dict[str, list[tuple[int, float]]] = {name: [] for name in ROVERS}
        self.commands: dict[str, list[Twist]] = {name: [] for name in ROVERS}
        self.wanted_m_s: dict[str, float] = {}  # where it is not SPEED_M_S
        self.odometry: dict[str, Odometry] = {}
        self.events: list[FaultEvent] = []
        self.status: dict[str, DiagnosticStatus] = {}
        self._stop_asked = threading.Event()
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node("drivers", context=self.context)
        self._executor = EventsExecutor(context=self.context)
        self._executor.add_node(self.node)
        node = self.node
        self._raws = {}
        for name in ROVERS:
            best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
            self._raws[name] = node.create_publisher(
                Twist, f"/{name}/cmd_vel_raw", best_effort if name == BEST_EFFORT else 10
            )
            node.create_subscription(Twist, f"/{name}/cmd_vel", partial(self._on_got, name), 100)
            node.create_subscription(Odometry, f"/{name}/odom", partial(self._on_odom, name), 10)
        node.create_subscription(FaultEvent, "/coach/events", self.events.append, 1000)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        node.create_timer(PERIOD_S, self._drive, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def __enter__(self) -> Drivers:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop_asked.set()
        self.join(timeout=WAIT_S)
        assert not self.is_alive(), "the drivers hang"
        close(self._executor, self.node, self.context)

    def run(self) -> None:
        while not self._stop_asked.is_set():
            self._executor.spin_once(timeout_sec=0.02)

    def _drive(self) -> None:
        for name, publisher in self._raws.items():
            message = Twist()
            message.linear.x = self.wanted_m_s.get(name, SPEED_M_S)
            message.angular.z = TURN_RAD_S
            message.linear.z = float(len(self.sent[name]))
            self.sent[name].append((len(self.sent[name]), time.monotonic()))
            publisher.publish(message)

    def _on_got(self, name: str, message: Twist) -> None:
        self.got[name].append((int(message.linear.z), time.monotonic()))
        self.commands[name].append(message)

    def _on_odom(self, name: str, message: Odometry) -> None:
        self.odometry[name] = message

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.status[status.hardware_id] = status

    # --- for the test's thread --------------------------------------------------------------

    def until(self, done: Callable[[], bool], what: str, timeout_s: float = WAIT_S) -> None:
        end = time.monotonic() + timeout_s
        while not done():
            assert time.monotonic() < end, f"not within {timeout_s} s: {what} ({self.heard()})"
            time.sleep(0.005)

    def heard(self) -> str:
        """Of each rover: subscribers to what it is told, commands got, and whether it tells."""
        told = {name: publisher.get_subscription_count() for name, publisher in self._raws.items()}
        got = {name: len(self.got[name]) for name in ROVERS}
        return f"subscribers {told}, got {got}, odometry of {sorted(self.odometry)}"

    def drive_on(self, commands: int = 10) -> None:
        """Waits until so many more commands were sent to each rover."""
        goal = len(self.sent[ROVERS[-1]]) + commands
        self.until(lambda: len(self.sent[ROVERS[-1]]) >= goal, "the drivers' next commands")

    def speed_m_s(self, name: str) -> float:
        """As the rover itself measures it."""
        return float(self.odometry[name].twist.twist.linear.x)

    def x_m(self, name: str) -> float:
        return float(self.odometry[name].pose.pose.position.x)

    def effects(self, name: str) -> list[FaultEvent]:
        return [e for e in list(self.events) if e.robot == name and e.kind == FaultEvent.EFFECT]

    def says(self, name: str, words: str) -> None:
        """Waits until /diagnostics says so of the rover."""

        def told() -> bool:
            return name in self.status and words in self.status[name].message

        self.until(told, f"{name}: {words} (now: {self.status.get(name)})")
