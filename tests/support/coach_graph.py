"""What the tests of coach and gate share: their processes, and a node that plays sim and team."""

from __future__ import annotations

import array
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType

import rclpy
from coach_operator import WAIT_S, Operator, close
from crash_coach_interfaces.msg import Action, CrashPlan, EpisodeState, FaultEvent, Observation
from node_process import Child, start
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from shared_memory import kill_group

# Read when a process creates its first participant; children inherit it.
os.environ.setdefault(
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    str(Path(__file__).parents[2] / "ros_ws/src/crash_coach_bringup/config/fastdds.xml"),
)

ROBOTS = ("robot_1", "robot_2", "robot_3")
N_ACTIONS = 5
NEWEST = QoSProfile(depth=1)
PLAN = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
EPISODE = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
EVENTS = QoSProfile(depth=1000)
Key = tuple[int, int]


def arguments(**parameters: object) -> list[str]:
    """--ros-args of parameters; lists, booleans and numbers in YAML's flow style."""
    values = []
    for name, value in parameters.items():
        text = f"[{', '.join(value)}]" if isinstance(value, tuple) else str(value)
        values += ["-p", f"{name}:={text.lower() if isinstance(value, bool) else text}"]
    return ["--ros-args", *values]


@contextmanager
def process(
    env: dict[str, str],
    name: str,
    package: str = "crash_coach_pkg",
    rules: Sequence[str] = (),
    **parameters: object,
) -> Iterator[Child]:
    """An executable in a session of its own, gone when the block is left.

    ``rules``: remapping, ``from:=to``.
    """
    child = start(name, package, [*arguments(**parameters), *remapped(rules)], env)
    try:
        yield child
    finally:
        ended = child.poll()
        kill_group(child)
        _, said = child.communicate(timeout=WAIT_S)
        if ended:  # pytest shows it where the test failed
            print(f"{name} ended by itself, {ended}:\n{said}")


def remapped(rules: Sequence[str]) -> list[str]:
    return [word for rule in rules for word in ("-r", rule)]


def run_to_end(
    env: dict[str, str], name: str, rules: Sequence[str] = (), **parameters: object
) -> tuple[int, str]:
    """Exit code and stderr of an executable that ends by itself."""
    with process(env, name, rules=rules, **parameters) as child:
        _, said = child.communicate(timeout=WAIT_S)
        assert child.returncode is not None
        return child.returncode, said


@dataclass
class Outcome:
    """What became of one robot-step."""

    raw: Action
    command: Action | None = None
    effects: list[FaultEvent] = field(default_factory=list)

    @property
    def done(self) -> bool:
        return self.command is not None or any(
            e.applied == FaultEvent.WITHHELD for e in self.effects
        )

    @property
    def faulted(self) -> bool:
        return self.command is None or self.command.fault != Action.FAULT_NONE


class Team:
    """Plays the sim and the policies of ROBOTS; thread-safe to read.

    Observation k makes action (k + robot) % N_ACTIONS; every action but 4 is available.
    """

    def __init__(self, domain: int, seed: int = 0) -> None:
        self.seed = seed
        self.outcomes: dict[tuple[int, int, int], Outcome] = {}
        self.events: list[FaultEvent] = []
        self.plans: list[CrashPlan] = []
        self.newest: Key = (-1, -1)
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node("test_team", context=self.context)
        self.executor = EventsExecutor(context=self.context)
        self.executor.add_node(self.node)
        node = self.node
        self._states = node.create_publisher(EpisodeState, "/sim/boundary", EPISODE)
        self._observations, self._raws = [], []
        for robot, name in enumerate(ROBOTS):
            self._observations.append(
                node.create_publisher(Observation, f"/{name}/observation", NEWEST)
            )
            self._raws.append(node.create_publisher(Action, f"/{name}/command_raw", NEWEST))
            node.create_subscription(
                Action, f"/{name}/command", partial(self._on_command, robot), NEWEST
            )
        self._in_force = None
        node.create_subscription(FaultEvent, "/coach/events", self._on_event, EVENTS)
        node.create_subscription(CrashPlan, "/coach/plan", self.plans.append, PLAN)

    def close(self) -> None:
        close(self.executor, self.node, self.context)

    def _on_command(self, robot: int, message: Action) -> None:
        self.outcomes[message.episode, message.step, robot].command = message

    def _on_event(self, message: FaultEvent) -> None:
        self.events.append(message)
        if message.kind == FaultEvent.EFFECT and message.applied != FaultEvent.OBSERVED:
            key = (message.episode, message.step, ROBOTS.index(message.robot))
            self.outcomes[key].effects.append(message)

    def until(self, done: Callable[[], bool], what: str, timeout_s: float = WAIT_S) -> None:
        """Serves callbacks until ``done``."""
        end = time.monotonic() + timeout_s
        while not done():
            assert time.monotonic() < end, f"not within {timeout_s} s: {what}"
            self.executor.spin_once(timeout_sec=0.02)

    def serve(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)

    def meet(self, gate: bool = True, coach: bool = True, follows: bool = True) -> None:
        """Waits until the processes under test have found this node, and it them.

        ``follows``: the coach follows /sim. Without a gate this node says that no plan is in force.
        """
        n = self.node
        if not gate:
            self._in_force = n.create_publisher(CrashPlan, "/coach/plan_in_force", PLAN)
            self._in_force.publish(CrashPlan())

        def met() -> bool:
            ready = True
            if gate:
                ready = (
                    all(
                        n.count_subscribers(f"/{r}/command_raw")
                        and n.count_publishers(f"/{r}/command")
                        for r in ROBOTS
                    )
                    and n.count_publishers("/coach/events") > 0
                )
            if coach:
                ready = ready and (not follows or n.count_subscribers("/sim/boundary") > 0)
                ready = ready and n.count_publishers("/coach/plan") > 0
            return ready

        self.until(met, "gate and coach on the graph")
        self.serve(0.2)  # both sides of a match are told one after the other

    def announce(self, episode: int, step: int, ended: bool = False, success: bool = False) -> None:
        state = EpisodeState(episode=episode, step=step, seed=self.seed)
        state.terminated, state.success = ended, success
        self._states.publish(state)

    def publish(self, episode: int, step: int) -> None:
        """The observations of a step and the policies' answers."""
        self.newest = (episode, step)
        available = array.array("B", [1, 1, 1, 1, 0])
        for robot in range(len(ROBOTS)):
            message = Observation(episode=episode, step=step, available_actions=available)
            message.header.stamp.sec, message.header.stamp.nanosec = episode, step
            raw = Action(
                header=message.header, episode=episode, step=step, action=(step + robot) % N_ACTIONS
            )
            self.outcomes.setdefault((episode, step, robot), Outcome(raw))
            self._observations[robot].publish(message)
            self._raws[robot].publish(raw)

    def step(self, episode: int, step: int, timeout_s: float = WAIT_S) -> list[Outcome]:
        """One lock-step: publishes, resends, and waits for every robot's decision."""
        self.announce(episode, step)
        outcomes: list[Outcome] = []
        resend_s = 0.0
        end = time.monotonic() + timeout_s
        while not outcomes or not all(outcome.done for outcome in outcomes):
            now = time.monotonic()
            assert now < end, f"no decision on episode {episode} step {step}"
            if now >= resend_s:
                self.publish(episode, step)
                outcomes = [self.outcomes[episode, step, r] for r in range(len(ROBOTS))]
                resend_s = now + 0.25
            self.executor.spin_once(timeout_sec=0.02)
        return outcomes

    def armed(self) -> list[int]:
        """Revisions that the gate armed."""
        return [event.revision for event in self.events if event.kind == FaultEvent.ARMED]

    def kinds(self) -> list[int]:
        """Of the events that are no EFFECT, in order."""
        return [event.kind for event in self.events if event.kind != FaultEvent.EFFECT]


@dataclass
class Graph:
    """Gate and coach as processes, the team and an operator in the test."""

    env: dict[str, str]
    team: Team
    operator: Operator
    gate: Child
    coach: Child


@contextmanager
def team(env: dict[str, str]) -> Iterator[Team]:
    played = Team(int(env["ROS_DOMAIN_ID"]))
    try:
        yield played
    finally:
        played.close()


@contextmanager
def operator(env: dict[str, str]) -> Iterator[Operator]:
    setter = Operator(int(env["ROS_DOMAIN_ID"]))
    try:
        yield setter
    finally:
        setter.close()


@contextmanager
def graph(
    env: dict[str, str],
    lockstep: bool = True,
    gate: Mapping[str, object] = MappingProxyType({}),
    **coach: object,
) -> Iterator[Graph]:
    """``coach`` and ``gate``: their parameters at start, beside the robots."""
    with ExitStack() as stack:
        gate_process = stack.enter_context(
            process(env, "gate", robots=ROBOTS, lockstep=lockstep, **gate)
        )
        coach_process = stack.enter_context(process(env, "coach", robots=ROBOTS, **coach))
        played = stack.enter_context(team(env))
        played.meet(follows=bool(coach.get("follow_sim", True)))
        setter = stack.enter_context(operator(env))
        yield Graph(env, played, setter, gate_process, coach_process)
