"""The relay gate's core: commands as opaque bytes, steps as ticks of a clock."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crash_coach_pkg.effects import RELAYED, WITHHELD
from crash_coach_pkg.gate.plan_book import EventKind
from crash_coach_pkg.gate.relay_gate import Outputs, Relay, Sent
from crash_coach_pkg.gate.step_clock import StepClock
from crash_coach_pkg.plan import NEXT_STEP, CrashPlan, Fault, Trigger, TriggerKind
from crash_coach_pkg.ros.command_types import OpaqueTools

N = 3
DT_S = 0.1
LEASE_S = 5.0
START_S = 1000.0
OPAQUE = frozenset(("availability",))
_numbers = count()


class Stream:
    """A relay, and everything that came out of it."""

    def __init__(self) -> None:
        clock = StepClock(DT_S)
        clock.step("test", int(START_S * 1e9))
        self.relay = Relay(N, lambda now_s: clock.step("test", int(now_s * 1e9)))
        self.relay.know(OPAQUE, lambda command: OpaqueTools())
        self.outputs: Outputs = []
        self.revision = 0

    def at(self, step: float) -> float:
        """Time; a little into the tick, so that rounding does not matter."""
        return START_S + (step + 0.01) * DT_S

    def command(self, robot: int, step: float, data: bytes | None = None) -> list[bytes]:
        """What ``robot`` got in consequence."""
        data = data if data is not None else b"%d" % next(_numbers)
        new = self.relay.command(robot, data, self.at(step))
        self.outputs += new
        return sent(new, robot)

    def tick(self, step: float) -> Outputs:
        new = self.relay.tick(self.at(step))
        self.outputs += new
        return new

    def plan(self, *faults: Fault, step: float, cap: int = N) -> Outputs:
        self.revision += 1
        plan = CrashPlan(0, self.revision, 7, 0.0, cap, faults)
        new = self.relay.plan(plan, LEASE_S, self.at(step))
        self.outputs += new
        return new

    def kinds(self) -> list[EventKind]:
        return [it.kind for it in self.outputs if not isinstance(it, Sent)]

    def effects(self, robot: int) -> list[tuple[int, int]]:
        """(step, applied) of each."""
        return [
            (it.step, it.applied)
            for it in self.outputs
            if not isinstance(it, Sent) and it.kind == EventKind.EFFECT and it.robot == robot
        ]


def sent(outputs: Outputs, robot: int) -> list[bytes]:
    return [it.data for it in outputs if isinstance(it, Sent) and it.robot == robot]


def test_without_a_fault_the_very_object_passes() -> None:
    stream = Stream()
    data = b"some bytes"
    assert stream.command(0, 0, data)[0] is data
    assert stream.command(0, 0.2)  # however many in a tick
    assert stream.kinds() == []


def test_a_muted_robot_gets_nothing_and_the_others_everything() -> None:
    stream = Stream()
    stream.plan(Fault(1, "mute", NEXT_STEP), step=0)
    for step in range(5):
        assert len(stream.command(0, step)) == 1
        assert stream.command(1, step) == []
    assert stream.effects(1) == [(step, WITHHELD) for step in range(5)]
    assert stream.effects(0) == []
    assert stream.kinds()[:2] == [EventKind.ARMED, EventKind.ACTIVE]


def test_a_plan_governs_from_the_first_tick_that_nothing_was_relayed_of() -> None:
    stream = Stream()
    assert stream.command(0, 4)
    armed = stream.plan(Fault(0, "mute", NEXT_STEP), step=4)[0]
    assert not isinstance(armed, Sent)
    assert (armed.kind, armed.step) == (EventKind.ARMED, 5)
    assert stream.command(0, 4.5)
    assert not stream.command(0, 5)
    silent = Stream()
    armed = silent.plan(Fault(0, "mute", NEXT_STEP, duration_steps=2), step=40)[0]
    assert not isinstance(armed, Sent)
    assert armed.step == 40
    assert [bool(silent.command(0, step)) for step in (40, 41, 42)] == [False, False, True]


def test_under_a_fault_a_robot_has_one_command_per_tick_the_newest_that_waited() -> None:
    stream = Stream()
    stream.plan(Fault(0, "drop", NEXT_STEP, parameters=(("probability", 0.0),)), step=0)
    assert stream.command(0, 0, b"a") == [b"a"]
    assert stream.command(0, 0.3, b"b") == []
    assert stream.command(0, 0.6, b"c") == []
    assert sent(stream.tick(1), 0) == [b"c"]
    assert stream.command(0, 1.5, b"d") == []
    assert sent(stream.tick(2), 0) == [b"d"]
    assert stream.effects(0) == [(step, RELAYED) for step in range(3)]


def test_what_waited_when_the_fault_ended_passes() -> None:
    stream = Stream()
    stream.plan(Fault(0, "mute", NEXT_STEP, duration_steps=1), step=0)
    assert not stream.command(0, 0)
    assert not stream.command(0, 0.5, b"newest")
    assert stream.command(0, 1, b"next") == [b"newest", b"next"]


def test_freeze_repeats_the_last_command_that_passed() -> None:
    stream = Stream()
    stream.command(0, 0, b"last")
    stream.plan(Fault(0, "freeze", NEXT_STEP), step=0)
    assert [stream.command(0, step) for step in (1, 2)] == [[b"last"], [b"last"]]


def test_delayed_commands_arrive_once_also_while_the_publisher_pauses() -> None:
    stream = Stream()
    stream.plan(Fault(0, "delay", NEXT_STEP, parameters=(("steps", 3),)), step=0)
    got: dict[int, list[bytes]] = {}
    for step in range(10):
        if step < 5:  # then it pauses
            got[step] = stream.command(0, step, b"%d" % step)
        else:
            # What is due in a tick without a command goes out as the tick ends.
            got[step - 1] = [*got.get(step - 1, []), *sent(stream.tick(step), 0)]
    assert {step: data for step, data in got.items() if data} == {
        3: [b"0"], 4: [b"1"], 5: [b"2"], 6: [b"3"], 7: [b"4"]
    }  # fmt: skip
    assert [applied for _, applied in stream.effects(0)] == [WITHHELD] * 3 + [RELAYED] * 5


def test_clearing_and_recovery_are_told() -> None:
    stream = Stream()
    stream.plan(Fault(0, "mute", NEXT_STEP, duration_steps=2), Fault(1, "mute"), step=0)
    stream.tick(1)
    assert stream.kinds() == [EventKind.ARMED, EventKind.ACTIVE, EventKind.ACTIVE]
    stream.tick(2)
    assert stream.kinds()[3:] == [EventKind.CLEARED]
    stream.plan(step=2)
    assert stream.kinds()[4:] == [EventKind.ARMED, EventKind.CLEARED]
    assert stream.command(1, 3)


def test_a_silent_coach_loses_its_lease() -> None:
    stream = Stream()
    stream.plan(Fault(0, "mute", NEXT_STEP), step=0)
    assert not stream.command(0, LEASE_S / DT_S - 1)
    stream.tick(LEASE_S / DT_S + 1)
    assert stream.kinds()[-1] == EventKind.EXPIRED
    assert stream.command(0, LEASE_S / DT_S + 1)
    assert stream.relay.book.in_force.faults == ()


@pytest.mark.parametrize(
    ("episode", "fault", "reason"),
    [
        (3, Fault(0, "mute"), "follow_sim:=false"),
        (0, Fault(0, "random"), "crash mode random needs a way to draw random commands"),
        (0, Fault(0, "bias"), "crash mode bias needs velocities"),
        (0, Fault(0, "adversarial"), "crash mode adversarial needs the command that the policy"),
        (0, Fault(0, "blind"), "changes observations"),
        (0, Fault(0, "none"), "unknown crash mode 'none'"),
        (0, Fault(0, "delay", parameters=(("steps", 0),)), "parameter steps = 0"),
        (
            0,
            Fault(0, "mute", trigger=Trigger(TriggerKind.NEAR, (0.0, 0.0, 1.0))),
            "condition NEAR looks at",
        ),
    ],
)
def test_what_cannot_be_carried_out_is_refused_with_the_reason(
    episode: int, fault: Fault, reason: str
) -> None:
    stream = Stream()
    (event,) = stream.relay.plan(CrashPlan(episode, 1, 0, 0.0, N, (fault,)), LEASE_S, START_S)
    assert not isinstance(event, Sent)
    assert event.kind == EventKind.REFUSED
    assert reason in event.detail
    assert stream.command(0, 1)


robots = st.integers(0, N - 1)
faults = st.builds(
    Fault,
    robot=robots,
    mode=st.sampled_from(("mute", "freeze", "delay", "drop")),
    start_step=st.sampled_from((NEXT_STEP, 0, 3, 12)),
    duration_steps=st.integers(0, 6),
    trigger=st.sampled_from((Trigger(), Trigger(TriggerKind.HAZARD, (0.3,)))),
)
Act = Callable[[Stream, float], object]
acts: st.SearchStrategy[Act] = st.one_of(
    robots.map(lambda robot: lambda stream, step: stream.command(robot, step)),
    st.lists(faults, max_size=3).map(lambda f: lambda stream, step: stream.plan(*f, step=step)),
    st.just(lambda stream, step: stream.tick(step)),
)


histories = st.lists(st.tuples(acts, st.sampled_from((0.0, 0.3, 1.0, 4.0))), max_size=60)


@settings(max_examples=200)
@given(histories, st.booleans())
def test_laws_of_any_history(history: list[tuple[Act, float]], by_lease: bool) -> None:
    check(history, by_lease)


@pytest.mark.soak
@pytest.mark.timeout(1800)
@settings(max_examples=10_000)
@given(histories, st.booleans())
def test_ten_thousand_histories(history: list[tuple[Act, float]], by_lease: bool) -> None:
    check(history, by_lease)


def check(history: list[tuple[Act, float]], by_lease: bool) -> None:
    stream, step = Stream(), 0.0
    for act, passed in history:
        step += passed
        act(stream, step)
    for robot in range(N):
        steps = [step for step, _ in stream.effects(robot)]
        assert steps == sorted(set(steps)), "one effect per robot and tick"
        data = [int(it) for it in sent(stream.outputs, robot)]
        assert data == sorted(data), "commands keep their order"
    if by_lease:
        step += LEASE_S / DT_S + 1
        stream.tick(step)
    else:
        stream.plan(step=step)
        step += 1
        stream.tick(step)
    for robot in range(N):
        new = b"%d" % next(_numbers)
        assert stream.command(robot, step, new) == [new]


def test_where_the_clock_stands_so_does_the_step() -> None:
    step = 0
    relay = Relay(N, lambda now_s: step)
    relay.know(OPAQUE, lambda command: OpaqueTools())
    passing = Fault(0, "drop", parameters=(("probability", 0.0),))
    relay.plan(CrashPlan(0, 1, 7, 0.0, N, (passing,)), LEASE_S, 0.0)
    outputs = [relay.command(0, b"%d" % number, 0.1 * number) for number in range(5)]
    assert [len(sent(it, 0)) for it in outputs] == [1, 0, 0, 0, 0]
    step = 1
    assert sent(relay.tick(0.6), 0) == [b"4"]  # the newest
    assert relay.decided()[0].step == 1
    relay.tick(LEASE_S + 1.0)  # the lease runs on all the same
    assert relay.command(0, b"after", LEASE_S + 1.1) == [Sent(0, b"after")]


class TestStepClock:
    def test_steps_are_exact(self) -> None:
        clock = StepClock(0.1)
        readings = range(5_000_000_000, 8_000_000_000, 10_000_000)
        assert [clock.step("sim", at) for at in readings] == [i // 10 for i in range(300)]

    def test_it_stands_and_goes_on(self) -> None:
        clock = StepClock(0.1)
        clock.step("sim", 0)
        assert [clock.step("sim", at) for at in (250_000_000,) * 3 + (300_000_000,)] == [2, 2, 2, 3]

    def test_a_jump_back_costs_no_step(self) -> None:
        clock = StepClock(0.1)
        clock.step("sim", 10**9)
        assert clock.step("sim", 2 * 10**9) == 10
        assert clock.step("sim", 5) == 10
        assert clock.step("sim", 5 + 10**9) == 20

    def test_another_clock_costs_no_step_and_adds_none(self) -> None:
        clock = StepClock(0.1)
        clock.step("none", 0)
        assert clock.step("sim", 10**18) == 0
        assert clock.step("sim", 10**18 + 10**9) == 10
        assert clock.step("steady", 7) == 10
        assert clock.step("steady", 7 + 10**8) == 11
