"""A graph's topics and services, served by a thread of its own with a context of its own.

Subscribes like anybody and asks like anybody: the graph never waits for it.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial
from typing import Any, Protocol

from crash_coach_interfaces.msg import Arena, ArenaState, CrashPlan, EpisodeState, FaultEvent
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.client import Client
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from std_srvs.srv import SetBool, Trigger

from crash_coach_common.ros.entities import destroy_subscription
from crash_coach_common.ros.qos import ARENA, EVENTS, PLAN

SPIN_S = 0.02
ANSWER_S = 10.0
"""Longest wait for the answer of a service."""

NEWEST_OR_LOST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
SERVICES = {
    "set": (SetParametersAtomically, "coach/set_parameters_atomically"),
    "clear_all": (Trigger, "coach/clear_all"),
    "pause": (SetBool, "sim/pause"),
    "step": (Trigger, "sim/step"),
    "reset": (Trigger, "sim/reset"),
    # Made last: once its question is answered, the coach knows the clients before it too.
    "get": (GetParameters, "coach/get_parameters"),
}


class Listener(Protocol):
    """Hears everything on the link's thread."""

    def on_arena(self, message: Arena) -> None: ...
    def on_state(self, message: ArenaState) -> None: ...
    def on_boundary(self, message: EpisodeState) -> None: ...
    def on_event(self, message: FaultEvent) -> None: ...
    def on_plan(self, message: CrashPlan) -> None: ...
    def on_plan_in_force(self, message: CrashPlan) -> None: ...
    def on_diagnostics(self, message: DiagnosticArray) -> None: ...
    def on_odometry(self, robot: str, message: Odometry) -> None: ...
    def on_problem(self, text: str) -> None:
        """What ended the link: nothing more is heard."""
        ...

    def on_tick(self, now_s: float) -> None:
        """Every few hundredths of a second; ``now_s`` of a steady clock."""
        ...


class Silent:
    """Hears nothing: for who only asks."""

    def on_problem(self, text: str) -> None:
        pass

    def on_tick(self, now_s: float) -> None:
        pass


class GraphLink:
    """``domain`` None: the environment's. ``namespace``: of the graph, '' for none.

    ``listen`` false: it asks only.
    """

    def __init__(
        self, listener: Listener | Silent, domain: int | None, namespace: str, listen: bool = True
    ) -> None:
        self._listener: Any = listener
        self._listen = listen
        self._domain = domain
        self._namespace = namespace
        self._tasks: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._clients: dict[str, Client] = {}
        self._node: Node | None = None
        self._odometry: list[Subscription] = []
        self._open: dict[Any, tuple[Future[Any], float]] = {}
        self._started: Future[None] = Future()
        self._thread = threading.Thread(target=self._run, name="graph link", daemon=True)

    def start(self) -> None:
        """Returns when the node is there. Raises what kept it from being made."""
        self._thread.start()
        self._started.result(timeout=ANSWER_S)

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()

    def follow(self, robots: Sequence[str]) -> None:
        """On the link's thread: hears the odometry of these robots, and of nobody else."""
        assert self._node is not None  # made before the thread serves
        for reader in self._odometry:
            destroy_subscription(self._node, reader)
        self._odometry = [
            self._node.create_subscription(
                Odometry,
                f"{robot}/odom",
                partial(self._listener.on_odometry, robot),
                NEWEST_OR_LOST,
            )
            for robot in robots
        ]

    def run(self, task: Callable[[], None]) -> None:
        """Runs ``task`` on the link's thread, soon."""
        self._tasks.put(task)

    def call(self, service: str, request: Any) -> Future[Any]:
        """Calls one of SERVICES from any thread.

        The future raises TimeoutError where the service is not there, or no answer comes in
        ANSWER_S.
        """
        answer: Future[Any] = Future()

        def ask() -> None:
            client = self._clients[service]
            if not client.service_is_ready():
                answer.set_exception(TimeoutError(f"there is no {client.srv_name}"))
                return
            asked = client.call_async(request)
            self._open[asked] = (answer, time.monotonic() + ANSWER_S)

        self.run(ask)
        return answer

    def ready(self, service: str) -> bool:
        """Whether somebody serves it."""
        return bool(self._clients[service].service_is_ready())

    def _run(self) -> None:
        context = Context()
        executor = node = None
        try:
            context.init(args=[], domain_id=self._domain)
            node = self._node = self._make_node(context)
            executor = EventsExecutor(context=context)
            executor.add_node(node)
        except Exception as error:  # noqa: BLE001  # told to whoever called start
            self._started.set_exception(error)
        else:
            self._started.set_result(None)
            self._serve(executor)
        finally:
            # In this order: DDS must not call back into what is gone (the executor first lets go).
            if executor is not None:
                executor.shutdown()
            if node is not None:
                node.destroy_node()
            context.try_shutdown()

    def _serve(self, executor: EventsExecutor) -> None:
        try:
            while not self._stop.is_set():
                executor.spin_once(timeout_sec=SPIN_S)
                self._work()
        except Exception as error:
            self._listener.on_problem(f"the console lost this graph: {error!r}")
            raise

    def _work(self) -> None:
        while not self._tasks.empty():
            self._tasks.get()()
        now_s = time.monotonic()
        for asked, (answer, until_s) in list(self._open.items()):
            if asked.done():
                del self._open[asked]
                answer.set_result(asked.result())
            elif now_s > until_s:
                del self._open[asked]
                answer.set_exception(TimeoutError(f"no answer within {ANSWER_S:g} s"))
        self._listener.on_tick(now_s)

    def _make_node(self, context: Context) -> Node:
        node = Node(
            "crash_coach_console",
            context=context,
            namespace=self._namespace or None,
            use_global_arguments=False,
            enable_rosout=False,
        )
        if self._listen:
            self._subscribe(node)
        for name, (type_, service) in SERVICES.items():
            self._clients[name] = node.create_client(type_, service)
        return node

    def _subscribe(self, node: Node) -> None:
        hear = self._listener
        sub = node.create_subscription
        sub(Arena, "sim/arena", hear.on_arena, ARENA)
        sub(ArenaState, "sim/arena_state", hear.on_state, NEWEST_OR_LOST)
        # Volatile: what ended before this node came says nothing about who was crashed in it.
        sub(EpisodeState, "sim/boundary", hear.on_boundary, QoSProfile(depth=100))
        sub(FaultEvent, "coach/events", hear.on_event, EVENTS)
        sub(CrashPlan, "coach/plan", hear.on_plan, PLAN)
        sub(CrashPlan, "coach/plan_in_force", hear.on_plan_in_force, PLAN)
        sub(DiagnosticArray, "diagnostics", hear.on_diagnostics, QoSProfile(depth=10))
