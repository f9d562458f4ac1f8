"""Faults on a team that this project does not simulate: rovers that listen to Twist only."""

from __future__ import annotations

import math
import os
import statistics
import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from coach_graph import operator, process, run_to_end
from coach_operator import Operator
from crash_coach_interfaces.msg import FaultEvent
from diagnostic_msgs.msg import DiagnosticStatus
from fleet_drivers import BEST_EFFORT, PERIOD_S, ROVERS, SPEED_M_S, Drivers
from geometry_msgs.msg import Twist, TwistStamped
from kept_running import kept_running
from node_process import Child
from rclpy.serialization import deserialize_message, serialize_message
from shared_memory import strike

from crash_coach_bringup.ros import discovery
from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_common.contract import UserError
from crash_coach_pkg.ros.command_types import Limits, command_type

VICTIM, OTHER = ROVERS[0], ROVERS[1]
TYPE = "geometry_msgs/msg/Twist"
LEASE_S = 0.9
LIMIT_M_S, LIMIT_RAD_S = 0.4, 0.7


@dataclass
class Fleet:
    drivers: Drivers
    operator: Operator
    coach: Child

    def fault(self, mode: str, victim: str = VICTIM, **parameters: float) -> int:
        """From its return on, every later step of ``victim`` is faulted; the number sent last."""
        own = {f"{mode}.{name}": value for name, value in parameters.items()}
        refused = self.operator.set(enabled=True, victims=[victim], crash_mode=mode, **own)
        assert not refused, refused
        d = self.drivers
        known = len(d.effects(victim))
        d.until(lambda: len(d.effects(victim)) > known, f"the first effect of {mode}")
        return d.sent[victim][-1][0]

    def clear(self) -> None:
        answer = self.operator.clear()
        assert answer.success, answer.message
        self.drives_as_before()

    def drives_as_before(self) -> None:
        """Every command of every rover arrives, in order, unchanged, and they move."""
        d = self.drivers
        d.drive_on(3)  # those under way while the fault ended
        first = {name: d.sent[name][-1][0] for name in ROVERS}
        d.drive_on(6)
        for name in ROVERS:
            goal = first[name] + 5
            d.until(lambda: d.got[name][-1][0] >= goal, f"commands of {name}")  # noqa: B023
            got = [n for n, _ in list(d.got[name]) if n > first[name]]
            assert got == list(range(got[0], got[0] + len(got)))
            assert d.commands[name][-1].linear.x == SPEED_M_S
        d.until(lambda: all(d.speed_m_s(name) == SPEED_M_S for name in ROVERS), "rovers that drive")


def rover(env: dict[str, str], name: str) -> AbstractContextManager[None]:
    script = str(Path(__file__).parents[2] / "support" / "fleet.py")
    return kept_running([sys.executable, script, name], env)


@pytest.fixture(scope="module")
def fleet() -> Iterator[Fleet]:
    with pytest.MonkeyPatch.context() as patch, ExitStack() as stack:
        domain = stack.enter_context(reserve_domain())
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.setenv(discovery.VARIABLE, discovery.profiles_file())
        env = dict(os.environ)
        limits = {"limit.linear_x_m_s": LIMIT_M_S, "limit.angular_z_rad_s": LIMIT_RAD_S}
        gate = process(
            env,
            "gate",
            robots=ROVERS,
            command_type=TYPE,
            dt_s=PERIOD_S,
            cmd_timeout_s=0.5,
            **limits,
        )
        stack.enter_context(gate)
        coach = stack.enter_context(
            process(env, "coach", robots=ROVERS, follow_sim=False, dt_s=PERIOD_S, lease_s=LEASE_S)
        )
        for name in ROVERS:
            stack.enter_context(rover(env, name))
        drivers = stack.enter_context(Drivers(domain))
        made = Fleet(drivers, stack.enter_context(operator(env)), coach)
        drivers.until(
            lambda: all(drivers.got[name] and name in drivers.odometry for name in ROVERS),
            "commands through the gate (of best-effort publishers too) and odometry",
        )
        yield made


@pytest.fixture
def driving(fleet: Fleet) -> Iterator[Fleet]:
    """The fleet, on which every fault is cleared afterwards."""
    fleet.drives_as_before()
    yield fleet
    fleet.clear()


def test_a_muted_rover_stops_and_the_others_drive_on(driving: Fleet) -> None:
    d = driving.drivers
    driving.fault("mute")
    d.until(lambda: d.speed_m_s(VICTIM) == 0.0, "a rover that stops")
    before = {name: d.x_m(name) for name in ROVERS}
    d.says(VICTIM, "muted by plan (mute)")
    assert d.status[VICTIM].level == DiagnosticStatus.WARN
    d.says(OTHER, "ok")
    d.says(BEST_EFFORT, "ok")
    for name in (OTHER, BEST_EFFORT):
        d.until(lambda: d.x_m(name) != before[name], f"{name} on its way")  # noqa: B023
    assert d.x_m(VICTIM) == before[VICTIM]
    effects = d.effects(VICTIM)
    assert {(e.mode, e.intent, e.applied) for e in effects} == {("mute", -1, FaultEvent.WITHHELD)}
    steps = [e.step for e in effects]
    assert steps == sorted(set(steps))
    assert not d.effects(OTHER)


def test_a_frozen_rover_gets_its_last_command_again(driving: Fleet) -> None:
    sent = driving.fault("freeze")
    driving.drivers.drive_on()
    got = [n for n, at in list(driving.drivers.got[VICTIM])][-8:]
    assert len(set(got)) == 1
    assert got[0] <= sent


def test_commands_are_late_by_the_steps_of_delay(driving: Fleet) -> None:
    d, steps = driving.drivers, 6
    first = driving.fault("delay", steps=steps) + 1
    d.drive_on(steps + 12)
    sent_s = dict(d.sent[VICTIM])
    late_s = [at_s - sent_s[n] for n, at_s in list(d.got[VICTIM]) if n >= first]
    assert len(late_s) > 5
    # A step is known to within one period; the machine may add to it.
    assert min(late_s) > (steps - 1) * PERIOD_S
    assert statistics.median(late_s) < (steps + 2) * PERIOD_S
    assert len({n for n, _ in list(d.got[VICTIM]) if n >= first}) == len(late_s), "arrived twice"


def test_dropped_commands_are_lost_and_the_others_are_untouched(driving: Fleet) -> None:
    d = driving.drivers
    first = driving.fault("drop", probability=0.5) + 1
    d.drive_on(30)
    got = [n for n, _ in list(d.got[VICTIM]) if n >= first]
    assert 5 <= len(got) <= 25  # of 30; seeded, and 1 in 10,000 otherwise
    assert got == sorted(set(got))
    applied = {e.applied for e in d.effects(VICTIM) if e.mode == "drop"}
    assert applied == {FaultEvent.WITHHELD, FaultEvent.RELAYED}


@pytest.mark.parametrize(
    ("mode", "parameters", "expected_m_s"),
    [
        ("bias", {"linear_x_m_s": 0.1}, SPEED_M_S + 0.1),
        ("bias", {"linear_x_m_s": 0.3}, LIMIT_M_S),
        ("scale", {"linear": -0.5}, SPEED_M_S * -0.5),
        ("scale", {"linear": -9.0}, -LIMIT_M_S),
    ],
)
def test_velocities_are_changed(
    driving: Fleet, mode: str, parameters: dict[str, float], expected_m_s: float
) -> None:
    d = driving.drivers
    driving.fault(mode, **parameters)
    d.until(lambda: d.speed_m_s(VICTIM) == expected_m_s, f"a rover that drives {expected_m_s} m/s")
    assert d.speed_m_s(OTHER) == SPEED_M_S


def test_random_commands_stay_within_the_limits(driving: Fleet) -> None:
    d = driving.drivers
    driving.fault("random", victim=BEST_EFFORT)
    d.drive_on(20)
    drawn = d.commands[BEST_EFFORT][-15:]
    assert all(abs(t.linear.x) <= LIMIT_M_S and abs(t.angular.z) <= LIMIT_RAD_S for t in drawn)
    assert len({t.linear.x for t in drawn}) > 10
    assert all(t.linear.y == 0.0 for t in drawn)


def test_commands_that_are_not_finite_pass_counted_and_are_never_changed(driving: Fleet) -> None:
    d = driving.drivers
    before = len(d.commands[OTHER])
    d.wanted_m_s[OTHER] = math.nan
    d.until(lambda: math.isnan(d.commands[OTHER][-1].linear.x), "a command as it came")
    d.says(OTHER, "commands with a velocity that is not finite: ")
    counts = {value.key: value.value for value in d.status[OTHER].values}
    assert int(counts["not_finite"]) > 0
    for mode, parameters in (("scale", {"linear": 0.5}), ("bias", {"angular_z_rad_s": 0.1})):
        driving.fault(mode, victim=OTHER, **parameters)
        d.drive_on(5)
        known = len(d.commands[OTHER])
        d.drive_on(5)
        assert len(d.commands[OTHER]) == known > before, mode
        assert d.effects(OTHER)[-1].applied == FaultEvent.WITHHELD
    driving.fault("random", victim=OTHER)
    d.drive_on(3)
    known = len(d.commands[OTHER])
    d.drive_on(5)
    drawn = d.commands[OTHER][known:]
    assert drawn
    assert all(abs(command.linear.x) <= LIMIT_M_S for command in drawn)
    d.wanted_m_s.clear()


def test_what_twists_cannot_have_is_refused(driving: Fleet) -> None:
    refused = driving.operator.set(enabled=True, victims=[VICTIM], crash_mode="adversarial")
    assert "crash mode adversarial needs the command that the policy values least" in refused
    driving.drives_as_before()


def test_somebody_else_on_a_command_topic_is_reported(driving: Fleet) -> None:
    d = driving.drivers
    intruder = d.node.create_publisher(Twist, f"/{OTHER}/cmd_vel", 1)
    d.says(OTHER, "somebody else publishes on its command topic: /drivers")
    events = [e for e in list(d.events) if e.kind == FaultEvent.INTRUDER]
    assert [e.robot for e in events] == [OTHER]
    assert "/drivers" in events[0].detail
    d.node.destroy_publisher(intruder)
    d.until(lambda: "somebody" not in d.status[OTHER].message, "an intruder that goes")


def test_a_killed_coach_leaves_no_fault_behind(fleet: Fleet) -> None:
    d = fleet.drivers
    fleet.fault("delay", steps=10)
    start_s = time.monotonic()
    strike(fleet.coach.pid)
    d.until(lambda: d.events[-1].kind == FaultEvent.EXPIRED, "the end of the lease")
    assert time.monotonic() - start_s < LEASE_S + 1.0
    fleet.drives_as_before()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nowhere_msgs/msg/Twist", "package 'nowhere_msgs' cannot be loaded"),
        ("geometry_msgs/msg/Twirl", "package 'geometry_msgs' has no message 'Twirl'"),
        ("geometry_msgs/srv/Twist", "not of the form package/msg/Type"),
        ("Twist", "not of the form package/msg/Type"),
    ],
)
def test_an_unknown_type_is_an_error_that_says_what_is_wrong(name: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        command_type(name, Limits(1.0, 0.0, 1.0))


def test_an_unknown_type_ends_the_gate_with_one_line(ros_env: dict[str, str]) -> None:
    code, errors = run_to_end(ros_env, "gate", robots=ROVERS, command_type="nowhere_msgs/msg/Twist")
    assert code == 1
    assert errors.startswith("gate: error: parameter command_type = 'nowhere_msgs/msg/Twist': ")
    assert errors.count("\n") == 1


@pytest.mark.parametrize("name", ["Twist", "TwistStamped"])
class TestVelocities:
    """What faults make of them, of both types."""

    @staticmethod
    def made(name: str, frame: str = "", **linear: float) -> bytes:
        message = Twist() if name == "Twist" else TwistStamped()
        twist = message if name == "Twist" else message.twist
        if name == "TwistStamped":
            message.header.frame_id = frame
        for axis, value in linear.items():
            setattr(twist.linear, axis, value)
        return serialize_message(message)

    def test_no_fault_goes_beyond_a_limit_that_the_controller_keeps(self, name: str) -> None:
        kind = command_type(f"geometry_msgs/msg/{name}", Limits(1.0, 0.5, 2.0))
        data = self.made(name, x=0.8, y=-0.7, z=3.0)
        tools = kind.tools(data)
        changed = tools.with_vector(data, np.array([5.0, -5.0, 90.0, 7.0, 0.0, -5.0]))
        assert changed is not None
        # y: the controller itself wants more than the limit; z, and turning over x: none.
        assert tools.vector(changed).tolist() == [1.0, -0.7, 90.0, 7.0, 0.0, -2.0]

    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    def test_what_is_not_finite_is_never_sent(self, name: str, value: float) -> None:
        kind = command_type(f"geometry_msgs/msg/{name}", Limits(1.0, 0.5, 2.0))
        fine, wild = self.made(name, x=0.5), self.made(name, x=0.5, z=value)
        tools = kind.tools(fine)
        assert tools.with_vector(fine, np.array([0.1, 0, 0, value, 0, 0])) is None
        assert tools.with_vector(wild, tools.vector(wild) * 0.5) is None
        drawn = kind.tools(wild).sample(3)
        assert drawn is not None
        assert np.isfinite(tools.vector(drawn)).all()

    @pytest.mark.parametrize("frame", ["", "a", "base", "base_link", "robot_1/base_link"])
    @pytest.mark.parametrize("value", [0.25, math.nan, math.inf])
    def test_finite_is_read_off_the_bytes(self, name: str, frame: str, value: float) -> None:
        kind = command_type(f"geometry_msgs/msg/{name}", Limits(1.0, 0.5, 2.0))
        data = self.made(name, frame, x=1.0, z=value)
        assert kind.finite(data) == math.isfinite(value)
        assert not kind.finite(data[:-1])
        assert not kind.finite(data[:5])


def test_twists_with_a_header_keep_it() -> None:
    message = TwistStamped()
    message.header.frame_id = "base_link"
    message.twist.linear.x = 0.25
    data = serialize_message(message)
    tools = command_type("geometry_msgs/msg/TwistStamped", Limits(1.0, 0.5, 2.0)).tools(data)
    assert tools.vector(data).tolist() == [0.25, 0, 0, 0, 0, 0]
    drawn = tools.sample(12345)
    assert drawn is not None
    assert deserialize_message(drawn, TwistStamped).header == message.header
    x, y, z, *_, yaw = tools.vector(drawn)
    assert 0 < abs(x) <= 1.0
    assert 0 < abs(y) <= 0.5
    assert 0 < abs(yaw) <= 2.0
    assert z == 0
