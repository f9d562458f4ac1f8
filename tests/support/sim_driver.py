"""A sim process and a node that stands in for gate and policies; used by test_sim_node.py."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

import rclpy
from coach_graph import process
from crash_coach_interfaces.msg import Action, EpisodeState, FaultEvent, Observation
from node_process import Child
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from crash_coach_bringup.ros.client import greet

Env = dict[str, str]
ROBOTS = ("robot_1", "robot_2")
UP, DOWN, LEFT, RIGHT, STAY = range(5)
WAIT_S = 60.0


def sim(env: Env, **parameters: object) -> AbstractContextManager[Child]:
    """The sim, killed at the end if it still runs."""
    return process(env, "sim", "sim_pkg", **parameters)


def end_of(process: Child, driver: Driver | None = None) -> tuple[int, str]:
    """Exit code and stderr, in bounded time; the driver answers meanwhile."""
    if driver is not None:
        driver.until(lambda: process.poll() is not None)
    _, errors = process.communicate(timeout=WAIT_S)
    assert "Traceback" not in errors, errors
    return process.returncode, errors


class Driver:
    """Stands in for gate and policies: answers observations by a rule, and records."""

    def __init__(self, robots: tuple[str, ...] = ROBOTS) -> None:
        self.context = Context()
        rclpy.init(context=self.context)
        self.node = Node("driver", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        one = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
        self.one, self.ten = one, QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
        latched = QoSProfile(
            depth=100,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
        self.robots = robots
        self.rule: Callable[[int, Observation], int | None] = lambda i, o: STAY
        self.fault = Action.FAULT_NONE
        self.seen: list[tuple[int, Observation]] = []
        self.states: list[EpisodeState] = []
        self._commands = [self.node.create_publisher(Action, f"/{r}/command", one) for r in robots]
        self._events = self.node.create_publisher(FaultEvent, "/coach/events", 100)
        for i, robot in enumerate(robots):
            self.node.create_subscription(
                Observation, f"/{robot}/observation", partial(self._answer, i), one
            )
        self.node.create_subscription(EpisodeState, "/sim/episode", self.states.append, latched)

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)

    def command(self, robot: int, obs: Observation, action: int) -> None:
        message = Action(header=obs.header, episode=obs.episode, step=obs.step, action=action)
        message.fault = self.fault
        self._commands[robot].publish(message)

    def mute(self, robot: int, obs: Observation) -> None:
        event = FaultEvent(header=obs.header, kind=FaultEvent.EFFECT, episode=obs.episode)
        event.step, event.robot, event.mode = obs.step, self.robots[robot], "mute"
        event.intent, event.applied = UP, -1
        self._events.publish(event)

    def _answer(self, robot: int, obs: Observation) -> None:
        self.seen.append((robot, obs))
        action = self.rule(robot, obs)
        if action is not None:
            self.command(robot, obs, action)

    def until(self, what: Callable[[], Any], timeout_s: float = WAIT_S) -> Any:
        """Spins until ``what()`` is true and returns it."""
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            value = what()
            if value:
                return value
            self.executor.spin_once(timeout_sec=0.05)
        raise AssertionError(f"not within {timeout_s} s; {len(self.states)} episode states came")

    def spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)

    def call(self, service: str, kind: Any, request: Any) -> Any:
        client = self.node.create_client(kind, service)
        greet(self.node, "/sim", self.executor.spin_once, WAIT_S, "/sim")
        self.until(client.service_is_ready)
        future = client.call_async(request)
        self.until(future.done)
        return future.result()

    def trigger(self, service: str) -> Any:
        return self.call(service, Trigger, Trigger.Request())

    def ends(self) -> list[EpisodeState]:
        return [s for s in self.states if s.terminated or s.truncated]
