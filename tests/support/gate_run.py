"""A coach, a sim and policies around a gate, which hold all that it says against the oracle."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
from fault_oracle import OBSERVATION_MODES, WITHHELD, Oracle, random_action, world_of

from crash_coach_pkg.gate.action_gate import GateState
from crash_coach_pkg.gate.messages import Command, Decision, Outputs, Seen, Sight
from crash_coach_pkg.gate.plan_book import TEAM, Event, EventKind
from crash_coach_pkg.plan import CrashPlan, Fault

ROBOTS = 3
SEED = 99
LEASE_S = 1.0
AVAILABLE = np.array([True, True, False, True])
ACTIONS = (0, 1, 3, 2)  # 2 is not available: nothing may make a fault pass it on
WORST = 3
Key = tuple[int, int, int]


def delayed(entered: list[int], steps: int, key: Key) -> int:
    """The action that arrives at the last of the steps ``entered``, or WITHHELD."""
    arrived: list[list[int]] = [[] for _ in entered]
    for sent in entered:
        late = [place for place, now in enumerate(entered) if now >= sent + steps]
        if late:
            arrived[late[0]].append(sent)
    return ACTIONS[(arrived[-1][-1] + key[2]) % 4] if arrived[-1] else WITHHELD


@dataclass
class Run:
    """Plays coach, sim and policies against a gate and keeps what the gate says."""

    lockstep: bool
    relays: bool
    gate: GateState = field(init=False)
    now_s: float = 0.0
    episode: int = 0
    revision: int = 0
    sent: CrashPlan | None = None
    steps: list[int] = field(default_factory=lambda: [0] * ROBOTS)
    decided: dict[Key, Decision] = field(default_factory=dict)
    seen: dict[Key, Seen] = field(default_factory=dict)
    governs: list[Oracle | None] = field(default_factory=list)  # None: nothing does any more
    asked: set[Key] = field(default_factory=set)
    running: dict[int, list[tuple[int, int, str, int]]] = field(
        default_factory=lambda: defaultdict(list)
    )  # by robot: (episode, first step, mode, entry) of ACTIVE without its end
    observed: set[Key] = field(default_factory=set)
    wholes: int = 0  # steps that the gate took at once
    clears: list[tuple[int, int]] = field(default_factory=list)  # of the team: (episode, step)

    def __post_init__(self) -> None:
        self.gate = GateState(ROBOTS, self.lockstep, LEASE_S, self.relays)

    # --- what the gate says -----------------------------------------------------------------

    def take(self, outputs: Outputs) -> None:
        for output in outputs:
            if isinstance(output, Decision):
                self.decision(output)
            elif isinstance(output, Seen):
                self.sight(output)
            elif output.robot == TEAM:
                self.team_event(output)
            else:
                self.robot_event(output)

    def team_event(self, event: Event) -> None:
        keys = [*self.decided, *self.seen]
        here = [step for episode, step, _ in keys if episode == event.episode]
        assert event.step == max(here, default=-1) + 1
        if event.kind == EventKind.ARMED:
            assert self.sent is not None
            assert (event.episode, event.revision) == (self.sent.episode, self.sent.revision)
            if not self.continues(self.sent):
                self.governs.append(Oracle(self.sent, event.step, ROBOTS))
        elif event.kind == EventKind.EXPIRED:
            # At once: also what was held under an older plan.
            self.governs.append(None)
            self.running.clear()
        elif event.kind == EventKind.CLEARED:
            self.clears.append((event.episode, event.step))

    def continues(self, plan: CrashPlan) -> bool:
        """Whether the plan in force says the same, with its start steps resolved."""
        before = self.governs[-1] if self.governs else None
        if before is None or before.plan.episode != plan.episode:
            return False
        return before.plan.resolved(before.first).faults == plan.faults

    def robot_event(self, event: Event) -> None:
        if event.kind == EventKind.EFFECT:
            assert event.applied == -2
            self.observed.add((event.episode, event.step, event.robot))
            return
        assert event.kind in (EventKind.ACTIVE, EventKind.CLEARED)
        running = self.running[event.robot]
        if event.kind == EventKind.ACTIVE:
            running.append((event.episode, event.step, event.mode, event.entry))
            return
        # The team may have been told before that it ends here.
        ended = [r for r in running if (r[0], *r[2:]) == (event.episode, event.mode, event.entry)]
        assert ended, "cleared without having been active"
        running.remove(ended[0])

    def still_running(self, robot: int, now: tuple[int, int]) -> list[tuple[int, int, str, int]]:
        """What the events say is in force on the robot."""
        self.running[robot] = [
            r
            for r in self.running[robot]
            if r[0] == now[0] and not any(r[:2] < clear <= now for clear in self.clears)
        ]
        return self.running[robot]

    def oracle(self, key: Key) -> Oracle | None:
        """The newest plan that governs the step."""
        for oracle in reversed(self.governs):
            if oracle is None:
                return None
            if oracle.plan.episode == key[0] and oracle.first <= key[1]:
                return oracle
        return None

    def decision(self, decision: Decision) -> None:
        command = decision.command
        key = (*command.key, command.robot)
        if decision.repeated:
            assert decision == self.decided[key]._replace(repeated=True)
            return
        assert key not in self.decided, "decided twice"
        assert key in self.asked
        self.decided[key] = decision
        running = self.still_running(key[2], key[:2])
        oracle = self.oracle(key)
        found = None if oracle is None else oracle.in_force(key[2], key[1], observation=False)
        if oracle is None or found is None:
            of_sight = None if oracle is None else oracle.in_force(key[2], key[1], observation=True)
            assert decision.applied == command.action
            assert decision.mode == ("" if of_sight is None else of_sight[0].mode)
            assert decision.observation == (of_sight is not None)
            assert not [r for r in running if r[2] not in OBSERVATION_MODES]
            return
        fault, since = found
        assert (decision.mode, decision.entry) == (fault.mode, fault.entry)
        assert not decision.observation
        assert (fault.mode, fault.entry) in [r[2:] for r in running]
        assert decision.applied in self.right(oracle, fault, since, key, command.action)

    def right(
        self, oracle: Oracle, fault: Fault, since: int, key: Key, action: int
    ) -> tuple[int, ...]:
        """What may be passed on."""
        begun = max(since, oracle.first)
        # A fault sees the commands of the steps in which no later one of the plan counts instead.
        entered = [
            step
            for step in range(begun, key[1] + 1)
            if oracle.in_force(key[2], step, observation=False) == (fault, since)
        ]
        match fault.mode:
            case "mute":
                return (WITHHELD,)
            case "random":
                return (random_action(SEED, key, AVAILABLE),)
            case "adversarial":
                return (WORST,)
            case "drop":
                return (WITHHELD, action)
            case "delay":
                action = delayed(entered, int(fault.parameters[0][1]), key)
                return (action if action != WITHHELD and AVAILABLE[action] else WITHHELD,)
        wanted = [
            d.command.action
            for k, d in self.decided.items()
            if k[0] == key[0] and k[2] == key[2] and k[1] < entered[0]
        ]
        return (wanted[-1] if wanted and AVAILABLE[wanted[-1]] else WITHHELD,)

    def sight(self, seen: Seen) -> None:
        key = (*seen.sight.key, seen.sight.robot)
        if key in self.seen:
            assert seen is self.seen[key]
            return
        self.seen[key] = seen
        oracle = self.oracle(key)
        found = None if oracle is None else oracle.in_force(key[2], key[1], observation=True)
        assert (key in self.observed) == (found is not None)
        if found is None:
            assert seen.features is None
            return
        assert seen.features is not None
        assert seen.features is not seen.sight.features
        if found[0].mode == "blind":
            assert not seen.features.any()

    # --- what the others do -----------------------------------------------------------------

    def plan(self, new: tuple[Fault, ...]) -> None:
        self.revision += 1
        if not self.relays:
            new = tuple(f for f in new if f.mode not in OBSERVATION_MODES)
        self.sent = CrashPlan(self.episode, self.revision, SEED, 0.5, ROBOTS, new)
        self.beat()

    def repeat(self) -> None:
        """As a coach that came back would: it takes the faults from the plan in force."""
        if self.sent is not None and self.sent.episode == self.episode:
            self.plan(self.gate.book.in_force.faults)

    def beat(self) -> None:
        if self.sent is not None:
            self.take(self.gate.plan(self.sent, LEASE_S, self.now_s))

    def observe(self, robot: int) -> None:
        step = self.steps[robot]
        features = np.array([1.0, step, robot], dtype=np.float32)
        sight = Sight(robot, self.episode, step, features, AVAILABLE)
        self.take(self.gate.observation(sight, self.now_s))

    def world(self, step: int) -> None:
        world = world_of(self.episode, step, ROBOTS)
        self.take(self.gate.world(self.episode, step, world, self.now_s))

    def command(self, robot: int) -> None:
        """The policy's answer; in lock-step the gate may see it before what it looks at."""
        key = (self.episode, self.steps[robot])
        action = ACTIONS[(key[1] + robot) % 4]
        if not self.lockstep:
            self.world(key[1])
        if self.relays or not self.lockstep:
            self.observe(robot)
            if self.relays and (*key, robot) not in self.seen:
                self.world(key[1])
            if self.relays and (*key, robot) not in self.seen:
                return  # the policy has nothing to answer yet
        self.asked.add((*key, robot))
        self.take(self.gate.command(Command(robot, *key, action, WORST), self.now_s))
        self.world(key[1])
        self.observe(robot)

    def answer(self, robot: int) -> None:
        """A robot never runs ahead of the slowest."""
        if self.steps[robot] > min(self.steps):
            return
        self.command(robot)
        if (self.episode, self.steps[robot], robot) in self.decided:
            self.steps[robot] += 1

    def together(self) -> None:
        """Every robot's command at once, where none has to be looked at; else one by one."""
        step, term = self.steps[0], self.gate.book.at(self.steps[0])
        revision = self.gate.book.revision if term is None else term.revision
        commands = [
            Command(robot, self.episode, step, ACTIONS[(step + robot) % 4], WORST)
            for robot in range(ROBOTS)
        ]
        keeping_step = len(set(self.steps)) == 1 and not self.relays
        if not keeping_step or not self.gate.whole_step(self.episode, step, lambda: commands):
            for robot in range(ROBOTS):
                self.answer(robot)
            return
        self.wholes += 1
        assert not self.gate.whole_step(self.episode, step, lambda: commands), "decided twice"
        self.asked.update((self.episode, step, robot) for robot in range(ROBOTS))
        self.take(tuple(Decision(c, "", 0, c.action, revision) for c in commands))
        self.steps = [step + 1] * ROBOTS

    def silence(self, seconds: float) -> None:
        self.now_s += seconds
        self.take(self.gate.tick(self.now_s))

    def play(self, operation: str, argument: object) -> None:
        match operation, argument:
            case "plan", list():
                self.plan(tuple(argument))
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
            case "beat" | "repeat" | "together", _:
                getattr(self, operation)()
            case _:
                self.plan(())

    def again(self, robot: int) -> None:
        if self.steps[robot] > 0:
            key = (self.episode, self.steps[robot] - 1)
            self.take(self.gate.command(Command(robot, *key, 0), self.now_s))

    def next_episode(self, planned: bool) -> None:
        if len(set(self.steps)) == 1:
            self.episode += 1
            self.steps = [0] * ROBOTS
            if planned:
                self.plan(())
