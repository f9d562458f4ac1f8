"""The gate of robots that this project does not simulate: any topic, any type of command."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial

from rcl_interfaces.msg import IntegerRange, ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.subscription import Subscription

from crash_coach_common.contract import UserError
from crash_coach_common.ros.entities import destroy_subscription
from crash_coach_pkg.gate.health import Decided
from crash_coach_pkg.gate.plan_book import PlanBook
from crash_coach_pkg.gate.relay_gate import Outputs, Relay, Sent
from crash_coach_pkg.gate.step_clock import StepClock
from crash_coach_pkg.plan import CrashPlan
from crash_coach_pkg.ros.command_types import CommandType, Limits, command_type
from crash_coach_pkg.ros.endpoints import Offer, offered, types_published
from crash_coach_pkg.ros.gate_base import GateBase

AUTO = "auto"
_MATCH = "match"
_RELIABILITY = {
    "reliable": ReliabilityPolicy.RELIABLE,
    "best_effort": ReliabilityPolicy.BEST_EFFORT,
}
_DURABILITY = {
    "volatile": DurabilityPolicy.VOLATILE,
    "transient_local": DurabilityPolicy.TRANSIENT_LOCAL,
}
# Of publishers with default settings: what is asked for until one is seen.
_USUAL = Offer(ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)
_LOOK_S = 1.0
NS_PER_S = 1_000_000_000


class RelayGate:
    """Relays bytes; a serialized command is changed only where a fault in force asks for it.

    With ``command_type`` auto it begins once somebody publishes commands, and with their type.

    Parameters beside GateBase's: dt_s, limit.linear_x_m_s, limit.linear_y_m_s,
    limit.angular_z_rad_s, reliability, durability, depth.

    Raises:
        UserError: a parameter is wrong, or the type of command is not installed.
    """

    def __init__(self, base: GateBase) -> None:
        self._base = base
        self._limits = _limits(base)
        self._type: CommandType | None = None
        dt_s = base.number(
            "dt_s",
            0.1,
            (0.001, 60.0),
            "Length of a step of the faults, seconds (of /clock, with use_sim_time): the period of "
            "the robots' commands. Under a fault a robot gets at most one command per step. The "
            "coach's dt_s must be the same.",
        )
        self._reliability = _choice(base, "reliability", tuple(_RELIABILITY))
        self._durability = _choice(base, "durability", tuple(_DURABILITY))
        self._depth = _depth(base)
        n = len(base.robots)
        now_s = time.monotonic()
        self._steps = StepClock(dt_s)
        self._sim_ns = 0  # as last read of /clock; 0: nothing came yet
        self._relay = Relay(n, self._step_at)
        base.create_timer(dt_s, self._on_step, clock=Clock(clock_type=ClockType.STEADY_TIME))
        if base.get_parameter("use_sim_time").value:
            # Of a simulator that runs faster than the wall's clock, the timer above misses steps.
            base.create_timer(dt_s, self._on_step)
        self._commands = [0] * n
        self._relayed = [0] * n
        self._not_finite = [0] * n
        self._told_not_finite = [0] * n
        # Reliable satisfies robots of either kind.
        offer = Offer(
            _RELIABILITY.get(self._reliability, _USUAL.reliability),
            _DURABILITY.get(self._durability, _USUAL.durability),
        )
        self._asked: list[Offer] = [offer] * n
        self._publish: list[Callable[[bytes], None]] = []
        self._inputs: list[Subscription] = []
        self._mismatched = True  # look at once
        self._looked_s = now_s
        self._ambiguous: frozenset[str] = frozenset()
        if base.command_type != AUTO:
            self._begin(base.command_type)

    # --- as Gate ----------------------------------------------------------------------------

    @property
    def book(self) -> PlanBook:
        return self._relay.book

    @property
    def type_name(self) -> str:
        return "" if self._type is None else self._type.name

    def plan(self, plan: CrashPlan, lease_s: float, now_s: float) -> None:
        self._send(self._relay.plan(plan, lease_s, now_s))

    def tick(self, now_s: float) -> None:
        if self._mismatched or now_s - self._looked_s >= _LOOK_S:
            self._mismatched, self._looked_s = False, now_s
            self._look()
        self._send(self._relay.tick(now_s))

    def decided(self) -> Sequence[Decided]:
        return self._relay.decided()

    def counters(self, robot: int) -> Sequence[tuple[str, int]]:
        return (
            ("commands", self._commands[robot]),
            ("relayed", self._relayed[robot]),
            ("not_finite", self._not_finite[robot]),
        )

    def warning(self, robot: int) -> str:
        if self._ambiguous:
            return f"command_type auto: several types are published: {_listed(self._ambiguous)}"
        if self._base.get_clock().ros_time_is_active and not self._sim_ns:
            return "use_sim_time is set, but nothing came on /clock: steps stand still"
        if self._inputs and self._inputs[robot].get_publisher_count() > 0:
            return self._wild(robot)
        return f"nobody publishes on {self._base.resolve_topic_name(self._base.topics.raw[robot])}"

    def _wild(self, robot: int) -> str:
        """Whether commands that are not finite came since the last report."""
        count, before = self._not_finite[robot], self._told_not_finite[robot]
        self._told_not_finite[robot] = count
        if count == before:
            return ""
        text = f"commands with a velocity that is not finite: {count - before}"
        self._base.get_logger().warning(f"{self._base.robots[robot]}: {text}")
        return text

    def close(self) -> None:
        """Nothing is open that the node does not close."""

    # --- relaying ---------------------------------------------------------------------------

    def _on_command(self, robot: int, data: bytes) -> None:
        now_s = time.monotonic()
        self._base.health.heard(robot, now_s)
        self._commands[robot] += 1
        assert self._type is not None  # subscribed in ``_begin``
        self._not_finite[robot] += not self._type.finite(data)
        self._send(self._relay.command(robot, data, now_s))

    def _on_step(self) -> None:
        self._send(self._relay.tick(time.monotonic()))

    def _step_at(self, now_s: float) -> int:
        """By /clock where ``use_sim_time`` is set, otherwise by the steady clock."""
        clock = self._base.get_clock()
        if not clock.ros_time_is_active:
            return self._steps.step("steady", int(now_s * NS_PER_S))
        before, self._sim_ns = self._sim_ns, clock.now().nanoseconds
        if before and self._sim_ns != before:
            self._base.health.sim_moved(now_s)
        return self._steps.step("sim" if self._sim_ns else "none", self._sim_ns)

    def _send(self, outputs: Outputs) -> None:
        for output in outputs:
            if isinstance(output, Sent):
                self._publish[output.robot](output.data)
                self._relayed[output.robot] += 1
            else:
                self._base.send_events((output,))

    # --- type and quality of service ----------------------------------------------------------

    def _begin(self, type_name: str) -> None:
        """Relays commands of this type. Raises UserError where it is not installed."""
        self._type = command_type(type_name, self._limits)
        self._relay.know(self._type.offers, self._type.tools)
        qos = self._asked[0].request(self._depth)
        robots = range(len(self._base.robots))
        self._publish = [
            self._base.command_publisher(robot, self._type.message, qos).publish for robot in robots
        ]
        self._inputs = [self._subscribe(robot) for robot in robots]

    def _look(self) -> None:
        """At the publishers: which type, which service they offer."""
        if self._type is not None:
            self._match()
            return
        found = types_published(self._base, self._base.topics.raw)
        self._ambiguous = found if len(found) > 1 else frozenset()
        if len(found) == 1:
            (name,) = found
            self._base.get_logger().info(f"command_type auto: {name} is published")
            self._begin(name)
            self._match()

    def _subscribe(self, robot: int) -> Subscription:
        assert self._type is not None  # called by ``_begin``, or later
        return self._base.create_subscription(
            self._type.message,
            self._base.topics.raw[robot],
            partial(self._on_command, robot),
            self._asked[robot].request(self._depth),
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._on_mismatch),
            raw=True,
        )

    def _on_mismatch(self, _: object) -> None:
        """A publisher offers less than is asked for: not from here, where DDS is calling."""
        self._mismatched = True

    def _match(self) -> None:
        """Asks each robot's publishers for what all of them offer."""
        for robot, subscription in enumerate(self._inputs):
            found = offered(self._base, self._base.topics.raw[robot])
            if found is None:
                continue
            wanted = Offer(
                _RELIABILITY.get(self._reliability, found.reliability),
                _DURABILITY.get(self._durability, found.durability),
            )
            if wanted != self._asked[robot]:
                self._asked[robot] = wanted
                destroy_subscription(self._base, subscription)
                self._inputs[robot] = self._subscribe(robot)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(names))


def _limits(base: GateBase) -> Limits:
    about = "Twist types: no fault goes beyond plus and minus this, unless the controller does, "
    return Limits(
        base.number("limit.linear_x_m_s", 0.5, (0.0, 100.0), f"{about}m/s."),
        base.number("limit.linear_y_m_s", 0.0, (0.0, 100.0), f"{about}m/s."),
        base.number("limit.angular_z_rad_s", 1.0, (0.0, 100.0), f"{about}rad/s."),
    )


def _choice(base: GateBase, name: str, values: tuple[str, ...]) -> str:
    """A parameter of QoS; raises UserError naming the choices."""
    known = ", ".join((_MATCH, *values))
    value = base.text(
        name,
        _MATCH,
        f"Of the robots' command topics: {known}. match: what all publishers of the raw topic "
        "offer is asked for, and the usual (reliable, volatile) is offered to the robots.",
        (_MATCH, *values),
    )
    if value not in (_MATCH, *values):
        raise UserError(f"parameter {name} = {value!r}; one of: {known}")
    return value


def _depth(base: GateBase) -> int:
    descriptor = ParameterDescriptor(
        description="Commands kept per topic while they wait to be relayed or delivered.",
        read_only=True,
        integer_range=[IntegerRange(from_value=1, to_value=1000, step=1)],
    )
    value: int = base.declare_parameter("depth", 10, descriptor).value
    return value
