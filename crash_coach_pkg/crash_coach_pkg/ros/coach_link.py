"""The coach's topics: follows episodes, publishes plans and heartbeats, hears the gate."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from crash_coach_interfaces.msg import BlockResult, EpisodeState, FaultEvent
from crash_coach_interfaces.msg import CrashPlan as CrashPlanMessage
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from crash_coach_common.contract import UserError
from crash_coach_common.ros.peers import several
from crash_coach_common.ros.qos import BLOCKS, EPISODE, EVENTS, PLAN
from crash_coach_common.ros.qos_node import QosNode, overrides
from crash_coach_common.ros.run_node import TICK_S
from crash_coach_pkg.coach.live_coach import Control
from crash_coach_pkg.plan import CrashPlan
from crash_coach_pkg.ros.convert import (
    Played,
    message_from_plan,
    plan_from_message,
    played_from_bytes,
)

ARM_TIMEOUT_S = 5.0  # a busy machine may stand still for two
HEARTBEATS_PER_LEASE = 3
# How long the first plan waits for a gate to be discovered and to say what is in force. A gate
# always says something, so that only a coach without one waits for so long.
ADOPT_TIMEOUT_S = 5.0
PLAN_TOPIC, IN_FORCE_TOPIC = "coach/plan", "coach/plan_in_force"
ENDLESS = Played(episode=0, ended=False, success=False)


NAME = "_coach_link"  # a name that begins so is hidden from `ros2 node list` and `ros2 param list`


class CoachLink(QosNode):
    """``changed`` guards ``control`` and what the gate answered.

    Args:
        coach: the node that this is a part of: its clock and its log, under its name.
        follow_sim: follow the sim's episodes; otherwise episode 0 starts at once and never ends.
        check: called often; what it raises ends this node's thread.
    """

    def __init__(
        self,
        coach: Node,
        control: Control,
        robots: tuple[str, ...],
        follow_sim: bool,
        check: Callable[[], None],
    ) -> None:
        super().__init__(
            NAME,
            context=coach.context,
            # Namespace and remapping of the process count; a new name for /coach does not.
            cli_args=["--ros-args", "-r", f"__node:={NAME}"],
            parameter_overrides=overrides(coach),
            start_parameter_services=False,
            enable_rosout=False,
        )
        self._coach = coach
        self.control = control
        self.changed = threading.Condition()
        self._robots = robots
        self._check = check
        self.armed_since = ""  # of the plan that was armed last
        self._armed_revision = 0
        self._awaited = 0  # the revision whose answer is waited for, or was last
        self._refusal: str | None = None  # the gate's, of that revision
        self._due_s = 0.0
        self._started_s = time.monotonic()
        self._settled = False  # whether it is known what a coach before this one left in force
        self._told = False  # whether the gate has told it
        self._left: CrashPlan | None = None
        self._waiting: list[Played] = [] if follow_sim else [ENDLESS]
        # The coach's own, so that its name is what others see; publishing needs no executor.
        self._plans = coach.create_publisher(CrashPlanMessage, PLAN_TOPIC, PLAN)
        self.create_subscription(CrashPlanMessage, IN_FORCE_TOPIC, self._on_plan_in_force, PLAN)
        if follow_sim:
            self.create_subscription(
                EpisodeState, "sim/boundary", self._on_episode, EPISODE, raw=True
            )
        self.create_subscription(FaultEvent, "coach/events", self._on_event, EVENTS)
        self.create_subscription(BlockResult, "trainer/blocks", self._on_block, BLOCKS)
        self.create_timer(TICK_S, self._on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def publish(self, plan: CrashPlan | None) -> None:
        """Call with ``changed`` held; None publishes nothing."""
        if plan is None:
            return
        lease_s = self.control.settings.lease_s
        self._due_s = time.monotonic() + lease_s / HEARTBEATS_PER_LEASE - TICK_S
        stamp = self._coach.get_clock().now().to_msg()
        self._plans.publish(message_from_plan(plan, self._robots, lease_s, stamp))

    def await_gate(self, plan: CrashPlan) -> str:
        """Waits for ARMED, with ``changed`` held; returns what is wrong, or nothing."""
        revision = plan.revision
        self._awaited, self._refusal = revision, None
        answered = self.changed.wait_for(
            lambda: self._armed_revision >= revision or self._refusal is not None,
            timeout=ARM_TIMEOUT_S,
        )
        if not answered:
            problem = f"no gate armed the plan within {ARM_TIMEOUT_S:g} s"
        else:
            refusal = self._refusal
            problem = "" if refusal is None else f"the gate refused: {refusal}"
        # Coaches on one graph overrule each other, gates answer for each other.
        peers = (several(self._coach, topic) for topic in (PLAN_TOPIC, IN_FORCE_TOPIC))
        return "; ".join([problem, *filter(None, peers)]) if problem else ""

    def settle(self, at_once: bool = True) -> None:
        """Takes over what is in force, with ``changed`` held, and plans what waits for that.

        ``at_once``: whether the gate has told what it is or not.
        """
        if self._settled or not (at_once or self._may_settle()):
            return
        self._settled = True
        adopted = None if self._left is None else self.control.adopt(self._left)
        for played in self._waiting:
            self._follow(played)
        self._waiting.clear()
        if adopted is not None and self.control.plan == adopted:
            self.publish(adopted)

    def _may_settle(self) -> bool:
        if not self._waiting:
            return False
        return self._told or time.monotonic() - self._started_s >= ADOPT_TIMEOUT_S

    def _follow(self, played: Played) -> None:
        self.publish(self.control.follow(played.episode))
        record = self.control.finish(played.success) if played.ended else None
        if record is not None:
            self._coach.get_logger().info(f"block: {record}")

    def _on_episode(self, data: bytes) -> None:
        try:
            played = played_from_bytes(data)
        except UserError as error:
            self._coach.get_logger().error(f"{error}; ignored")
            return
        with self.changed:
            if self._settled:
                self._follow(played)
                return
            self._waiting.append(played)
            self.settle(at_once=False)

    def _on_block(self, message: BlockResult) -> None:
        with self.changed:
            try:
                record = self.control.evaluated(message.success_rate)
            except UserError as error:
                self._coach.get_logger().error(f"{error}; ignored")
                return
        if record is not None:
            self._coach.get_logger().info(f"block {message.block} of the trainer: {record}")

    def _on_plan_in_force(self, message: CrashPlanMessage) -> None:
        with self.changed:
            if self._settled:
                return
            self._told = True
            if message.revision:  # otherwise there never was a plan
                self._left = self._read(message)
            self.settle(at_once=False)

    def _read(self, message: CrashPlanMessage) -> CrashPlan | None:
        try:
            return plan_from_message(message, self._robots)
        except UserError as error:
            self._coach.get_logger().error(f"plan in force {message.revision}: {error}; ignored")
            return None

    def _on_event(self, message: FaultEvent) -> None:
        with self.changed:
            if self._armed_revision == 0:  # later, a newer coach would be fought over every event
                self.publish(self.control.overtake(message.revision))
            if not self.control.published(message.revision):
                return
            if message.kind == FaultEvent.ARMED:
                self._armed_revision = message.revision
                self.armed_since = f"armed at step {message.step} of episode {message.episode}"
                self.control.armed(message.revision, message.step)
                self.changed.notify_all()
            elif message.kind == FaultEvent.REFUSED:
                if message.revision == self._awaited:
                    self._refusal = message.detail
                self._coach.get_logger().error(f"the gate refused a plan: {message.detail}")
                self.changed.notify_all()

    def _on_tick(self) -> None:
        self._check()
        with self.changed:
            self.settle(at_once=False)
            if time.monotonic() >= self._due_s:
                self.publish(self.control.plan)
