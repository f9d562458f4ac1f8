"""A trainer and one running graph: a node with a context, an executor and a thread of its own."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

from crash_coach_interfaces.msg import BlockResult, EpisodeState, PolicyStatus
from rclpy.context import Context
from rclpy.experimental import EventsExecutor

from crash_coach_common.contract import EnvSpec, UserError
from crash_coach_common.ros.greet import greet
from crash_coach_common.ros.qos_node import QosNode
from policy_pkg.bags.dataset import RecordedEpisode
from policy_pkg.ros.trainer.topics import Heard, RobotMessages, TrainerTopics
from policy_pkg.train.live.inbox import Inbox, Lost
from policy_pkg.train.live.order import Task

SPIN_S = 0.05  # how soon a signal, or what another thread gave, is noticed
START_S = 120.0  # until the nodes of a graph are there; a cold start compiles
ACK_S = 5.0
ACK_POLL_S = 0.002
EPISODE_S = 60.0  # the sim itself gives up sooner where robots do not answer
PIECES_S = 10.0  # until the last messages of an episode that has ended are there
UINT32 = 2**32

Played = Callable[[Task, RecordedEpisode | None], None]


@dataclass(frozen=True)
class Graph:
    """Which graph, and how it runs. ``domain`` None: the environment's. ``seed``: of exploration.

    ``coached``: a coach has to hear the evaluation blocks.
    """

    index: int
    domain: int | None
    spec: EnvSpec
    lockstep: bool
    observation_topic: str
    seed: int
    coached: bool


class _Stopped(Exception):
    """The run ends: nobody has to be greeted any more."""


class GraphLink:
    """What both modes share; ``serve`` is the thread, which alone touches ROS.

    ``give`` and ``give_block`` can be called from any thread. ``played`` hears of every episode of
    a task.
    """

    spin_s = SPIN_S

    def __init__(self, graph: Graph, played: Played, stopped: Callable[[], bool]) -> None:
        self.graph, self._played, self._stopped = graph, played, stopped
        self.lost = 0
        """Episodes that could not be used."""
        self._context = Context()
        # The process's own arguments: namespace and remapping count on every domain.
        self._context.init(domain_id=graph.domain)
        self._node = QosNode(
            "trainer",
            context=self._context,
            start_parameter_services=False,
        )
        self._inbox = Inbox(
            f"graph {graph.index}",
            graph.spec.robots,
            graph.lockstep,
            graph.observation_topic != "observation",
            RobotMessages(),
        )
        heard = Heard(self._on_status, self._on_state, self._collect)
        self.topics = TrainerTopics(
            self._node, graph.spec, self._inbox, graph.observation_topic, heard
        )
        self._held: dict[str, int] = {}
        # Grows over restarts, so that what policies hold of a trainer before is not confused.
        self._version = time.time_ns() // 1_000_000 % UINT32
        self._make_clients()
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._failure: UserError | None = None
        self._given: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()

    def give(self, task: Task) -> None:
        self._given.put(partial(self._take, task))

    def give_block(self, block: BlockResult) -> Future[bool]:
        """Done when every coach has it (True), or did not take it within ACK_S."""
        told: Future[bool] = Future()
        self._given.put(partial(self._tell, block, told))
        return told

    def _tell(self, block: BlockResult, told: Future[bool]) -> None:
        self.topics.publish_block(block)
        deadline = time.monotonic() + ACK_S
        while not (acked := self.topics.block_taken()) and time.monotonic() < deadline:
            self._executor.spin_once(timeout_sec=ACK_POLL_S)
        told.set_result(acked)

    def serve(self) -> None:
        """Serves the graph until ``stopped``.

        Raises:
            UserError: something did not answer in time, or cannot be.
        """
        try:
            self._greet("sim")
            if ("gate", self._node.get_namespace()) in self._node.get_node_names_and_namespaces():
                self._greet("gate")
            self._guarded(self._ready)
            while not self._stopped():
                self._executor.spin_once(timeout_sec=self.spin_s)
                while not self._given.empty():
                    self._guarded(self._given.get())
                if self._failure is not None:
                    raise self._failure
                self._guarded(self._look)
        finally:
            # In this order: DDS must not call back into what is gone.
            self._executor.shutdown()
            self._node.destroy_node()
            self._context.try_shutdown()

    def _guarded(self, action: Callable[[], None]) -> None:
        """An exception in a callback would be told with a traceback."""
        try:
            action()
        except UserError as error:
            self._failure = self._failure or error

    def _greet(self, target: str) -> None:
        """Returns when ``target`` knows this node: then nothing that it says is lost."""

        def spin_once(spin_s: float) -> None:
            if self._stopped():
                raise _Stopped
            self._executor.spin_once(timeout_sec=spin_s)

        with suppress(_Stopped):
            greet(self._node, target, spin_once, START_S, f"{target} of {self._name}")

    @property
    def _name(self) -> str:
        domain = self.graph.domain
        where = "" if domain is None else f" (ROS domain {domain})"
        return f"graph {self.graph.index}{where}"

    def _publish(self, task: Task, from_episode: int) -> int:
        """Publishes the weights of ``task``; returns their version."""
        self._version = (self._version + 1) % UINT32
        self.topics.publish_weights(
            self._version, from_episode, task.epsilon, self.graph.seed, task.agent
        )
        return self._version

    def _silent(self, version: int) -> list[str]:
        """Robots whose policies do not say that they hold this version."""
        return [robot for robot in self.graph.spec.robots if self._held.get(robot) != version]

    def _on_status(self, status: PolicyStatus) -> None:
        self._held[status.robot] = status.version
        self._guarded(self._on_held)

    def _collect(self) -> None:
        if self._inbox.waiting:
            self._guarded(self._hand_on)

    def _hand_on(self) -> None:
        for outcome in self._inbox.take():
            if isinstance(outcome, Lost):
                self.lost += 1
                self._node.get_logger().warning(
                    f"{self._name}: episode {outcome.number} is left out: {outcome.reason}"
                )
                self._finished(outcome.number, None)
            else:
                self._finished(outcome.number, outcome)

    # What the modes do differently.

    def _make_clients(self) -> None:
        """Before the node is known to the graph."""

    def _take(self, task: Task) -> None:
        raise NotImplementedError

    def _ready(self) -> None:
        """The graph knows this node."""
        raise NotImplementedError

    def _on_held(self) -> None:
        """A policy said what it holds."""
        raise NotImplementedError

    def _on_state(self, state: EpisodeState) -> None:
        raise NotImplementedError

    def _finished(self, number: int, recorded: RecordedEpisode | None) -> None:
        raise NotImplementedError

    def _look(self) -> None:
        """Called several times per second."""
        raise NotImplementedError
