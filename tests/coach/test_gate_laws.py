"""Laws of the gate over random plans, commands, duplicates, silences and clears."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crash_coach_pkg.gate import random_available, random_bits
from crash_coach_pkg.gate_state import (
    NOTHING_APPLIED,
    Command,
    Decision,
    Event,
    EventKind,
    GateState,
    Outputs,
)
from crash_coach_pkg.plan import NEXT_STEP, CrashPlan, Fault, Mode

ROBOTS = 3
SEED = 99
LEASE_S = 1.0
AVAILABLE = np.array([True, True, False, True])
Key = tuple[int, int, int]

faults = st.builds(
    Fault,
    robot=st.integers(0, ROBOTS - 1),
    mode=st.sampled_from([Mode.MUTE, Mode.RANDOM]),
    start_step=st.one_of(st.just(NEXT_STEP), st.integers(0, 6)),
    duration_steps=st.integers(0, 4),
)
operations = st.lists(
    st.one_of(
        st.tuples(st.just("plan"), st.lists(faults, max_size=4)),
        st.tuples(st.just("step"), st.permutations(range(ROBOTS))),
        st.tuples(st.just("one"), st.integers(0, ROBOTS - 1)),
        st.tuples(st.just("again"), st.integers(0, ROBOTS - 1)),
        st.tuples(st.just("episode"), st.booleans()),
        st.tuples(st.just("silence"), st.floats(0.0, 0.7)),
        st.tuples(st.just("beat"), st.none()),
        st.tuples(st.just("clear"), st.none()),  # a plan without faults
    ),
    max_size=40,
)


@dataclass
class Run:
    """Plays coach, sim and policies against a gate and keeps what the gate says."""

    lockstep: bool
    gate: GateState = field(init=False)
    now_s: float = 0.0
    episode: int = 0
    revision: int = 0
    sent: CrashPlan | None = None
    steps: list[int] = field(default_factory=lambda: [0] * ROBOTS)
    decided: dict[Key, Decision] = field(default_factory=dict)
    governs: list[tuple[int, int, CrashPlan | None]] = field(default_factory=list)
    asked: set[Key] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.gate = GateState(ROBOTS, self.lockstep, first_lease_s=LEASE_S)

    def take(self, outputs: Outputs) -> None:
        for output in outputs:
            if isinstance(output, Event):
                self.event(output)
            else:
                self.decision(output)

    def event(self, event: Event) -> None:
        here = [step for episode, step, _ in self.decided if episode == event.episode]
        assert event.step == max(here, default=-1) + 1
        if event.kind == EventKind.ARMED:
            assert self.sent is not None
            assert (event.episode, event.revision) == (self.sent.episode, self.sent.revision)
            self.governs.append((event.episode, event.step, self.sent))
        elif event.kind == EventKind.EXPIRED:
            # At once: also what was held under an older plan.
            self.governs.append((event.episode, 0, None))

    def decision(self, decision: Decision) -> None:
        command = decision.command
        key = (*command.key, command.robot)
        if decision.repeated:
            assert decision == self.decided[key]._replace(repeated=True)
            return
        assert key not in self.decided, "decided twice"
        assert key in self.asked
        self.decided[key] = decision
        mode, seed = self.expected(*key)
        assert decision.mode == mode
        if mode == Mode.NONE:
            assert decision.applied == command.action
        elif mode == Mode.MUTE:
            assert decision.applied == NOTHING_APPLIED
        else:
            bits = random_bits(seed, *key)
            assert decision.applied == random_available(bits, AVAILABLE[None, :])[0]

    def expected(self, episode: int, step: int, robot: int) -> tuple[Mode, int]:
        """By the newest plan that governs the step; worked out apart from the gate's code."""
        for of, first, plan in reversed(self.governs):
            if plan is None:
                return Mode.NONE, SEED
            if of != episode or step < first:
                continue
            mode = Mode.NONE
            for fault in plan.faults:
                start = first if fault.start_step == NEXT_STEP else fault.start_step
                end = start + fault.duration_steps if fault.duration_steps else step + 1
                if fault.robot == robot and start <= step < end:
                    mode = fault.mode
            return mode, plan.seed
        return Mode.NONE, SEED

    def plan(self, new: list[Fault]) -> None:
        self.revision += 1
        self.sent = CrashPlan(self.episode, self.revision, SEED, 0.5, ROBOTS, tuple(new))
        self.beat()

    def beat(self) -> None:
        if self.sent is not None:
            self.take(self.gate.plan(self.sent, LEASE_S, self.now_s))

    def command(self, robot: int) -> None:
        """The policy's answer; in lock-step the gate sees it before its observation."""
        key = (self.episode, self.steps[robot])
        self.asked.add((*key, robot))
        action = int(np.flatnonzero(AVAILABLE)[(key[1] + robot) % 3])
        if not self.lockstep:
            self.take(self.gate.observation(robot, *key, AVAILABLE, self.now_s))
        self.take(self.gate.command(Command(robot, *key, action), self.now_s))
        self.take(self.gate.observation(robot, *key, AVAILABLE, self.now_s))

    def answer(self, robot: int) -> None:
        """In lock-step a robot never runs ahead of the slowest."""
        if self.steps[robot] > min(self.steps):
            return
        self.command(robot)
        if (self.episode, self.steps[robot], robot) in self.decided:
            self.steps[robot] += 1

    def silence(self, seconds: float) -> None:
        self.now_s += seconds
        self.take(self.gate.tick(self.now_s))

    def play(self, operation: str, argument: object) -> None:
        match operation, argument:
            case "plan", list():
                self.plan(argument)
            case "step", list() | tuple():
                for robot in argument:
                    self.answer(robot)
            case "one", int():
                self.answer(argument)
            case "again", int():
                self.again(argument)
            case "episode", bool():
                self.next_episode(argument)
            case "silence", float():
                self.silence(argument)
            case "beat", _:
                self.beat()
            case _:
                self.plan([])

    def again(self, robot: int) -> None:
        if self.steps[robot] > 0:
            key = (self.episode, self.steps[robot] - 1)
            self.take(self.gate.command(Command(robot, *key, 0), self.now_s))

    def next_episode(self, planned: bool) -> None:
        if len(set(self.steps)) == 1:
            self.episode += 1
            self.steps = [0] * ROBOTS
            if planned:
                self.plan([])


def check(lockstep: bool, played: list[tuple[str, object]], by_lease: bool) -> None:
    run = Run(lockstep)
    for operation, argument in played:
        run.play(operation, argument)
    if by_lease:
        # Until nothing is held: before the first plan a lease starts with a held command.
        run.answer(run.steps.index(min(run.steps)))
        before, first = len(run.decided), 0
        run.silence(LEASE_S)
    else:
        # The step under way may still be under the plan that is cleared, by rule.
        before, first = len(run.decided), 0
        run.plan([])
        first = run.governs[-1][1]
    last = max(run.steps) + 3
    for _ in range(ROBOTS * (last + 1)):
        run.answer(run.steps.index(min(run.steps)))
    assert min(run.steps) >= last, "a command was held for ever"
    after = [d for d in list(run.decided.values())[before:] if d.command.step >= first]
    assert len(after) >= 3 * ROBOTS - 1
    assert all(d.mode == Mode.NONE and d.applied == d.command.action for d in after)


@settings(deadline=None, max_examples=150)
@given(lockstep=st.booleans(), played=operations, by_lease=st.booleans())
def test_effects_equal_the_plan_and_a_clear_or_a_lapse_lets_everything_pass(
    lockstep: bool, played: list[tuple[str, object]], by_lease: bool
) -> None:
    check(lockstep, played, by_lease)


@pytest.mark.soak
@settings(deadline=None, max_examples=10_000)
@given(lockstep=st.booleans(), played=operations, by_lease=st.booleans())
def test_ten_thousand_runs(
    lockstep: bool, played: list[tuple[str, object]], by_lease: bool
) -> None:
    check(lockstep, played, by_lease)
