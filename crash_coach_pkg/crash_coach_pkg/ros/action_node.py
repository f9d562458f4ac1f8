"""The gate of scenario actions: relays what policies want to robots, faulted as planned."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial

from crash_coach_interfaces.msg import Action, EpisodeState
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from crash_coach_common.contract import UserError
from crash_coach_common.ros.qos import EPISODE, NEWEST
from crash_coach_common.ros.team_topics import (
    COMMANDS,
    OBSERVATIONS,
    RobotPublisher,
    TeamPublisher,
    subscribe,
)
from crash_coach_common.team_cdr import RobotMessage, common_step
from crash_coach_pkg.effects import WITHHELD
from crash_coach_pkg.gate.action_gate import GateState
from crash_coach_pkg.gate.health import Decided
from crash_coach_pkg.gate.messages import Command, Decision, Seen
from crash_coach_pkg.gate.plan_book import Event, PlanBook
from crash_coach_pkg.gate.step_commands import StepCommands
from crash_coach_pkg.plan import NEXT_STEP, CrashPlan
from crash_coach_pkg.ros.convert import (
    bytes_from_decision,
    bytes_from_seen,
    command_from_bytes,
    effect_from_decision,
    sight_from_bytes,
    world_from_message,
)
from crash_coach_pkg.ros.gate_base import ACTION_TYPE, GateBase


class ActionGate:
    """The gate of scenario actions, in lock-step or in real time.

    Parameters beside GateBase's: lockstep, first_lease_s, relay_observations.
    """

    def __init__(self, base: GateBase) -> None:
        self._base = base
        robots = base.robots
        lockstep = base.flag(
            "lockstep",
            True,
            "Hold the commands of an episode until its plan is there, and those under a fault "
            "that needs their observation until that is there. False (real time): never hold.",
        )
        first_lease_s = base.number(
            "first_lease_s",
            10.0,
            (0.0, 600.0),
            "Lock-step: how long the first commands are held for a coach that has not spoken "
            "yet, seconds.",
        )
        self._relays = base.flag(
            "relay_observations",
            False,
            "Relay /<robot>/observation to /<robot>/observation_seen, which policies then have to "
            "listen to: what observation faults need.",
        )
        self._state = GateState(len(robots), lockstep, first_lease_s, self._relays)
        self._watched: frozenset[int] = frozenset()  # robots whose availability is needed
        self._watching = False
        self._watches_world = False
        self._told = [(0, 0)] * len(robots)  # untold and ahead, as /diagnostics said them last
        topics = base.topics
        self._codec = COMMANDS.codec(robots)
        self._commands = TeamPublisher(
            base,
            COMMANDS,
            robots,
            topics.commands,
            topics.command_name.lstrip("/"),
            self._publisher,
        )
        self._step = StepCommands(len(robots)) if lockstep else None
        self._seen: TeamPublisher | None = None
        self._listen(lockstep)

    def _listen(self, lockstep: bool) -> None:
        base, topics = self._base, self._base.topics
        base.create_subscription(EpisodeState, "sim/boundary", self._on_boundary, EPISODE)
        if not lockstep:  # there the sim waits, and says loudly what it does not get
            base.create_subscription(Clock, "clock", self._on_clock, QoSProfile(depth=10), raw=True)
        raw_name = topics.raw_name.lstrip("/")
        on_commands, on_error = self._on_commands, self._on_error
        subscribe(
            base,
            COMMANDS,
            base.robots,
            topics.raw,
            raw_name,
            on_commands,
            on_error,
            lockstep,
            self._on_whole,
        )
        if self._relays:
            topics.check("observation", "observation_seen")
            seen = topics.within("observation_seen")
            self._seen = TeamPublisher(base, OBSERVATIONS, base.robots, seen, "observation_seen")
            self._watch()

    # --- as Gate ----------------------------------------------------------------------------

    @property
    def book(self) -> PlanBook:
        return self._state.book

    @property
    def type_name(self) -> str:
        return ACTION_TYPE

    def plan(self, plan: CrashPlan, lease_s: float, now_s: float) -> None:
        outputs = self._state.plan(plan, lease_s, now_s)
        if outputs:
            self._watched |= self._state.watched_robots
            if self._watched:
                self._watch()
            if self._state.needs_world and not self._watches_world:
                self._watches_world = True
                self._base.create_subscription(
                    EpisodeState, "sim/episode", self._on_episode, EPISODE
                )
        self._send(outputs)

    def tick(self, now_s: float) -> None:
        self._send(self._state.tick(now_s))

    def decided(self) -> Sequence[Decided]:
        decisions = [self._state.last(robot) for robot in range(len(self._base.robots))]
        return [
            Decided() if d is None else Decided(d.mode, d.command.episode, d.command.step)
            for d in decisions
        ]

    def counters(self, robot: int) -> Sequence[tuple[str, int]]:
        state = self._state
        late, ahead, untold = state.late[robot], state.ahead[robot], state.untold[robot]
        return (("late", late), ("ahead", ahead), ("untold", untold))

    def warning(self, robot: int) -> str:
        before, now = self._told[robot], (self._state.untold[robot], self._state.ahead[robot])
        self._told[robot] = now
        told = []
        if now[0] > before[0]:
            told.append("its policy does not tell its worst action: commands are withheld")
        if now[1] > before[1]:
            told.append("commands for an episode that the sim has not begun are ignored")
            self._base.get_logger().warning(f"{self._base.robots[robot]}: {told[-1]}")
        return "; ".join(told)

    def close(self) -> None:
        """Nothing is open that the node does not close."""

    # --- relaying ---------------------------------------------------------------------------

    def _publisher(self, robot: int, events: PublisherEventCallbacks) -> RobotPublisher:
        return self._base.command_publisher(robot, Action, NEWEST, events)

    def _watch(self) -> None:
        """Availability is needed from the first fault that asks for it on."""
        if self._watching:
            return
        self._watching = True
        base, topics = self._base, self._base.topics.within("observation")
        subscribe(
            base,
            OBSERVATIONS,
            base.robots,
            topics,
            "observation",
            self._on_observations,
            self._on_error,
            self._step is not None,
        )

    def _on_error(self, error: UserError) -> None:
        self._base.get_logger().error(f"{error}; ignored")

    def _refused(self, robot: int, error: UserError) -> None:
        self._base.get_logger().error(f"{self._base.robots[robot]}: {error}; ignored")

    def _on_whole(self, data: bytes, at: int) -> bool:
        """Passes on the very bytes of a step in which nobody is faulted."""
        key = common_step(data, at, len(self._base.robots))
        if key is None or key[1] == NEXT_STEP or not self._commands.whole:
            return False
        if not self._state.whole_step(*key, partial(self._commands_of, data)):
            return False
        self._commands.publish_whole(data)
        self._base.health.all_heard(time.monotonic())
        return True

    def _commands_of(self, data: bytes) -> list[Command]:
        return [command_from_bytes(robot, own) for robot, own in self._codec.split(data)]

    def _on_commands(self, messages: list[RobotMessage]) -> None:
        now_s = time.monotonic()
        outputs: list[Decision | Seen | Event] = []
        for robot, data in messages:
            self._base.health.heard(robot, now_s)
            try:
                command = command_from_bytes(robot, data)
            except UserError as error:
                self._refused(robot, error)
                continue
            outputs += self._state.command(command, now_s)
        self._send(outputs)

    def _on_boundary(self, message: EpisodeState) -> None:
        begins = message.step == 0 and not (message.terminated or message.truncated)
        if self._state.boundary(message.episode, begins):
            self._base.get_logger().warning(
                f"the sim was restarted: it begins episode {message.episode} (again)"
            )

    def _on_clock(self, _: bytes) -> None:
        self._base.health.sim_moved(time.monotonic())

    def _on_observations(self, messages: list[RobotMessage]) -> None:
        now_s = time.monotonic()
        outputs: list[Decision | Seen | Event] = []
        for robot, data in messages:
            if not self._relays and robot not in self._watched:
                continue
            try:
                sight = sight_from_bytes(robot, data)
            except UserError as error:
                self._refused(robot, error)
                continue
            outputs += self._state.observation(sight, now_s)
        self._send(outputs)

    def _on_episode(self, message: EpisodeState) -> None:
        try:
            world = world_from_message(message, len(self._base.robots))
        except UserError as error:
            self._base.get_logger().error(f"{error}; ignored")
            return
        self._send(self._state.world(message.episode, message.step, world, time.monotonic()))

    def _send(self, outputs: Sequence[Decision | Seen | Event]) -> None:
        commands: list[RobotMessage] = []
        seen: list[RobotMessage] = []
        for output in outputs:
            if isinstance(output, Decision):
                commands += self._decided(output)
            elif isinstance(output, Seen):
                seen.append((output.sight.robot, bytes_from_seen(output)))
            else:
                self._base.send_events((output,))
        if commands:
            self._commands.publish(commands)
        if seen and self._seen is not None:
            self._seen.publish(seen)

    def _decided(self, decision: Decision) -> list[RobotMessage]:
        """Tells an effect; returns the commands that go out now."""
        robot, withheld = decision.command.robot, decision.applied == WITHHELD
        data = None if withheld else bytes_from_decision(decision)
        # Repeated only where the receiver has nothing else to go by: one EFFECT per robot-step.
        if withheld or (decision.mode and not decision.observation and not decision.repeated):
            self._base.send_effect(effect_from_decision(decision, self._base.robots))
        alone = [] if data is None else [(robot, data)]
        if decision.repeated:
            self._commands.publish_alone(alone)  # what came first may be lost
            return []
        if self._step is None:
            return alone
        key = decision.command.key
        if robot in self._commands.together:
            return self._step.decided(key, robot, data)
        return alone + self._step.decided(key, robot, None)
