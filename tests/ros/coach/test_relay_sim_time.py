"""use_sim_time with robots of one's own: the faults' steps follow /clock."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import pytest
from coach_graph import operator, process
from coach_operator import WAIT_S, Operator
from crash_coach_interfaces.msg import FaultEvent
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist
from rclpy.clock import Clock as RosClock
from rclpy.clock import ClockType
from rosgraph_msgs.msg import Clock

from crash_coach_bringup.ros.client import GraphClient, graph_client

ROBOTS = ("rover_1", "rover_2")
VICTIM, OTHER = ROVERS = ROBOTS
DT_S, CLOCK_S = 0.05, 0.01
LOST_S = 0.5


class Simulator:
    """Publishes /clock at ``factor`` of the wall's pace, and what controllers want per step of it.

    Like Gazebo: time stands while it is ``paused``, and then controllers are silent.
    """

    def __init__(self, client: GraphClient) -> None:
        self.client = client
        self.factor = 1.0
        self.paused = False
        self.now_ns = 3_000_000_000
        self.got = dict.fromkeys(ROBOTS, 0)
        self.events: list[FaultEvent] = []
        self.said: dict[str, str] = {}
        self._before_s = time.monotonic()
        self._wanted = 0
        node = client.node
        self._clock = node.create_publisher(Clock, "/clock", 10)
        self._raws = [node.create_publisher(Twist, f"/{r}/cmd_vel_raw", 10) for r in ROBOTS]
        for name in ROBOTS:
            node.create_subscription(Twist, f"/{name}/cmd_vel", self._counter(name), 100)
        node.create_subscription(FaultEvent, "/coach/events", self.events.append, 1000)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        node.create_timer(CLOCK_S, self._tick, clock=RosClock(clock_type=ClockType.STEADY_TIME))

    def _counter(self, name: str) -> Callable[[Twist], None]:
        def count(_: Twist) -> None:
            self.got[name] += 1

        return count

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.said |= {status.hardware_id: status.message for status in message.status}

    def _tick(self) -> None:
        now_s = time.monotonic()
        passed_s, self._before_s = now_s - self._before_s, now_s
        if self.paused:
            return
        self.now_ns += int(passed_s * self.factor * 1e9)
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(self.now_ns, 10**9)
        self._clock.publish(message)
        wanted = int(self.now_ns / 1e9 / DT_S)
        if wanted != self._wanted:
            self._wanted = wanted
            for raw in self._raws:
                raw.publish(Twist())

    def until(self, done: Callable[[], bool], what: str) -> None:
        self.client.until(done, WAIT_S, f"{what}; said: {self.said}")

    def effects(self) -> list[FaultEvent]:
        return [e for e in self.events if e.kind == FaultEvent.EFFECT]

    def first(self, kind: int) -> FaultEvent:
        def found() -> bool:
            return any(e.kind == kind and e.robot == VICTIM for e in self.events)

        self.until(found, f"event {kind} of {VICTIM}")
        return next(e for e in self.events if e.kind == kind and e.robot == VICTIM)


@contextmanager
def simulated(env: dict[str, str]) -> Iterator[tuple[Simulator, Operator]]:
    shared = {"robots": ROBOTS, "dt_s": DT_S, "use_sim_time": True}
    with ExitStack() as stack:
        stack.enter_context(
            process(
                env,
                "gate",
                command_type="geometry_msgs/msg/Twist",
                cmd_timeout_s=LOST_S,
                **shared,
            )
        )
        stack.enter_context(process(env, "coach", follow_sim=False, **shared))
        client = stack.enter_context(graph_client("simulator", int(env["ROS_DOMAIN_ID"])))
        simulator = Simulator(client)
        setter = stack.enter_context(operator(env))
        client.greet("/gate", WAIT_S, "the gate")
        simulator.until(lambda: min(simulator.got.values()) > 2, "commands through the gate")
        yield simulator, setter


def at_s(event: FaultEvent) -> float:
    return float(event.header.stamp.sec + event.header.stamp.nanosec * 1e-9)


def crash(simulator: Simulator, setter: Operator, **more: object) -> None:
    """Mutes the victim from the next step on, while the simulator goes on."""
    names = ["enabled", "victims", "crash_mode", "apply_at", *more]
    values = [True, [VICTIM], "mute", "next_step", *more.values()]
    future = setter.begin(**dict(zip(names, values, strict=True)))
    simulator.until(lambda: setter.poll(future), "the coach's answer")
    assert future.result().result.successful, future.result().result.reason


@pytest.mark.parametrize("factor", [0.5, pytest.param(4.0, marks=pytest.mark.soak)])
def test_a_fault_lasts_its_steps_of_the_simulators_clock(
    ros_env: dict[str, str], factor: float
) -> None:
    with simulated(ros_env) as (simulator, setter):
        simulator.factor = factor
        began_s = time.monotonic()
        crash(simulator, setter, duration_steps=40)
        active, cleared = simulator.first(FaultEvent.ACTIVE), simulator.first(FaultEvent.CLEARED)
        took_s = time.monotonic() - began_s
        (armed,) = [e.step for e in simulator.events if e.kind == FaultEvent.ARMED][-1:]
        # On a busy machine the gate comes to a step late, never early, and may miss one.
        assert armed <= active.step
        assert armed + 40 <= cleared.step
        steps = [e.step for e in simulator.effects()]
        assert steps == sorted(set(steps))
        assert armed <= steps[0]
        assert steps[-1] < armed + 40
        assert len(steps) > 10
        # The stamps are the simulator's, and so is the pace.
        lasted_s = at_s(cleared) - at_s(active)
        assert abs(lasted_s - (cleared.step - active.step) * DT_S) <= DT_S
        assert took_s >= (lasted_s - DT_S) / factor


def test_in_a_pause_steps_stand_and_nobody_is_lost(ros_env: dict[str, str]) -> None:
    with simulated(ros_env) as (simulator, setter):
        simulator.factor = 0.5
        crash(simulator, setter)
        simulator.until(lambda: len(simulator.effects()) > 3, "effects")
        simulator.paused = True
        simulator.client.pause(0.3)  # what is under way
        known, got = len(simulator.effects()), simulator.got[OTHER]
        simulator.client.pause(3 * LOST_S)
        simulator.said.clear()
        simulator.until(lambda: len(simulator.said) == len(ROBOTS), "diagnostics")
        assert simulator.said == {
            VICTIM: "muted by plan (mute); the sim stands still",
            OTHER: "ok; the sim stands still",
        }
        assert (len(simulator.effects()), simulator.got[OTHER]) == (known, got)

        simulator.paused = False
        simulator.until(lambda: len(simulator.effects()) > known + 3, "effects after the pause")
        steps = [e.step for e in simulator.effects()]
        assert steps == sorted(set(steps))
        assert steps[-1] - steps[0] < 2 * len(steps)  # a second and a half would be 30 steps

        simulator.now_ns = 1_000_000_000  # the world is reset
        known = len(simulator.effects())
        simulator.until(lambda: len(simulator.effects()) > known + 3, "effects after the reset")
        steps = [e.step for e in simulator.effects()]
        assert steps == sorted(set(steps))
        assert steps[-1] - steps[0] < 2 * len(steps)


def test_a_clock_that_nobody_publishes_is_named(ros_env: dict[str, str]) -> None:
    silent = process(
        ros_env, "gate", robots=ROBOTS, command_type="geometry_msgs/msg/Twist", use_sim_time=True
    )
    with silent, graph_client("looker", int(ros_env["ROS_DOMAIN_ID"])) as client:
        said: list[str] = []
        client.node.create_subscription(
            DiagnosticArray,
            "/diagnostics",
            lambda message: said.extend(status.message for status in message.status),
            10,
        )
        client.until(lambda: len(said) > 0, WAIT_S, "diagnostics")
    assert "use_sim_time is set, but nothing came on /clock: steps stand still" in said[0]
