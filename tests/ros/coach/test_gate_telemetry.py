"""What the gate tells beside relaying: changes, refusals, plan in force, diagnostics, intruders."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable

import numpy as np
import pytest
from coach_graph import NEWEST, PLAN, ROBOTS, Graph, Team, graph, process, team
from crash_coach_interfaces.msg import Action, CrashPlan, Fault, FaultEvent, Observation
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from shared_memory import strike

FREEZE_1 = {"victims": ("robot_1",), "crash_mode": "freeze", "start_step": 2}


class Listener:
    """Hears /diagnostics and /coach/plan_in_force beside what the team hears."""

    def __init__(self, team: Team) -> None:
        self.team = team
        self.statuses: list[dict[str, DiagnosticStatus]] = []
        self.in_force: list[CrashPlan] = []
        node = team.node
        node.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, QoSProfile(depth=100)
        )
        node.create_subscription(CrashPlan, "/coach/plan_in_force", self.in_force.append, PLAN)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.statuses.append({status.name: status for status in message.status})

    def status(
        self, robot: int, wanted: Callable[[DiagnosticStatus], bool], what: str
    ) -> dict[str, str]:
        """Waits for a status of the gate about ``robot``; returns its values."""
        name = f"gate: {ROBOTS[robot]}"
        seen = len(self.statuses)

        def come() -> bool:
            return any(wanted(s[name]) for s in self.statuses[seen:] if name in s)

        self.team.until(come, f"{what} of {name}")
        found = next(s[name] for s in self.statuses[seen:] if name in s and wanted(s[name]))
        return {value.key: value.value for value in found.values}


def events(g: Graph | Team, kind: int) -> list[FaultEvent]:
    of = g.team if isinstance(g, Graph) else g
    return [event for event in of.events if event.kind == kind]


def test_changes_are_told_with_step_mode_and_entry(ros_env: dict[str, str]) -> None:
    config = {"victims": ("robot_2",), "start_step": 3, "duration_steps": 2, "crash_mode": "delay"}
    with graph(ros_env, **config) as g:
        for step in range(8):
            g.team.step(0, step)
        g.team.until(lambda: bool(events(g, FaultEvent.CLEARED)), "CLEARED")
        told = [
            (e.kind, e.robot, e.episode, e.step, e.mode, e.entry)
            for e in g.team.events
            if e.kind in (FaultEvent.ACTIVE, FaultEvent.CLEARED)
        ]
        assert told == [
            (FaultEvent.ACTIVE, "robot_2", 0, 3, "delay", 0),
            (FaultEvent.CLEARED, "robot_2", 0, 5, "delay", 0),
        ]
        # Told once more to a team that asks once more, as it does where the machine is busy.
        assert list(dict.fromkeys(e.step for e in events(g, FaultEvent.EFFECT))) == [3, 4]


def test_a_killed_coach_leaves_nothing_of_a_stateful_fault(ros_env: dict[str, str]) -> None:
    with graph(ros_env, lease_s=0.5, **FREEZE_1) as g:
        listener = Listener(g.team)
        for step in range(6):
            outcomes = g.team.step(0, step)
            action = step if step < 2 else 1  # the last one before the fault
            assert outcomes[0].command is not None
            assert outcomes[0].command.action == action
            assert outcomes[0].command.fault == (3 if step >= 2 else 0)
        g.team.until(lambda: bool(listener.in_force), "the plan in force")
        assert [f.mode for f in listener.in_force[-1].faults] == ["freeze"]
        strike(g.coach.pid)
        g.team.until(lambda: bool(events(g, FaultEvent.EXPIRED)), "EXPIRED")
        g.team.until(lambda: not listener.in_force[-1].faults, "the empty plan")
        for key in [(0, 6), (0, 7), (1, 0), (1, 1)]:
            for outcome in g.team.step(*key):
                assert outcome.command == outcome.raw
        assert len(events(g, FaultEvent.EXPIRED)) == 1


def test_the_plan_in_force_has_its_steps_resolved(ros_env: dict[str, str]) -> None:
    with graph(ros_env) as g:
        listener = Listener(g.team)
        for step in range(4):
            g.team.step(0, step)
        reason = g.operator.set(victims=["robot_3"], crash_mode="mute", apply_at="next_step")
        assert not reason
        g.team.until(
            lambda: bool(listener.in_force) and bool(listener.in_force[-1].faults), "the plan"
        )
        plan = listener.in_force[-1]
        assert [(f.robot, f.mode, f.start_step) for f in plan.faults] == [("robot_3", "mute", 4)]
        assert plan.revision == g.team.armed()[-1]


def test_diagnostics_tell_ok_muted_and_lost(ros_env: dict[str, str]) -> None:
    gate = {"cmd_timeout_s": 1.5}
    with graph(ros_env, gate=gate, victims=("robot_2",), crash_mode="random") as g:
        listener = Listener(g.team)
        g.team.step(0, 0)
        raw = Action(episode=0, step=0)
        g.team.step(0, 1)
        late = g.team.node.create_publisher(Action, "/robot_1/command_raw", NEWEST)
        g.team.until(lambda: late.get_subscription_count() > 0, "the gate")
        late.publish(raw)
        told = KeyValue(key="late", value="1")
        values = listener.status(
            0, lambda s: s.level == DiagnosticStatus.OK and told in s.values, "OK, one late"
        )
        assert (values["episode"], values["step"], values["state"]) == ("0", "1", "ok")
        assert values["ignored_plans"] == "0"
        g.team.step(0, 2)
        values = listener.status(1, lambda s: s.message == "muted by plan (random)", "the fault")
        assert (values["mode"], values["step"]) == ("random", "2")
        lost = listener.status(2, lambda s: s.level == DiagnosticStatus.ERROR, "lost")
        assert lost["state"] == "lost"


def test_in_real_time_a_pause_loses_nobody_and_a_wrong_episode_blocks_nobody(
    ros_env: dict[str, str],
) -> None:
    gate = {"robots": ROBOTS, "lockstep": False, "cmd_timeout_s": 0.6}
    with process(ros_env, "gate", **gate), team(ros_env) as t:
        t.meet(coach=False)
        node, listener = t.node, Listener(t)
        clock = node.create_publisher(Clock, "/clock", 10)
        wrong = node.create_publisher(Action, "/robot_1/command_raw", NEWEST)
        t.until(lambda: wrong.get_subscription_count() > 0, "the gate")
        t.until(lambda: clock.get_subscription_count() > 0, "the gate")
        t.until(lambda: node.count_subscribers("/sim/boundary") > 0, "the gate")
        t.announce(0, 0)
        t.serve(0.3)
        wrong.publish(Action(episode=2**32 - 1))
        t.serve(0.3)  # before the next command takes its place in the queue
        for step in range(5):
            clock.publish(Clock())
            assert not any(outcome.faulted for outcome in t.step(0, step))
        # Paused: no clock, no observations, no commands.
        values = listener.status(0, lambda s: "the sim stands still" in s.message, "the pause")
        assert (values["state"], values["step"]) == ("ok", "4")
        assert (values["ahead"], values["late"]) == ("1", "0")
        now = listener.statuses[-1]
        assert all(now[f"gate: {name}"].level == DiagnosticStatus.OK for name in ROBOTS)
        told = [status["gate: robot_1"].message for status in listener.statuses]
        assert sum("has not begun are ignored" in message for message in told) == 1
        for _ in range(10):  # it goes on, and nobody answers
            clock.publish(Clock())
            t.serve(0.1)
        listener.status(2, lambda s: s.level == DiagnosticStatus.ERROR, "lost")


def test_an_intruder_is_told_once_and_its_end(ros_env: dict[str, str]) -> None:
    with process(ros_env, "gate", robots=ROBOTS, first_lease_s=0.0), team(ros_env) as t:
        t.meet(coach=False)
        listener = Listener(t)
        t.step(0, 0)
        listener.status(1, lambda s: "somebody else" not in s.message, "nobody else")
        intruder = t.node.create_publisher(Action, "/robot_2/command", NEWEST)
        values = listener.status(1, lambda s: "somebody else" in s.message, "an intruder")
        assert "/test_team (gid " in values["intruders"]
        listener.status(1, lambda s: "somebody else" in s.message, "the intruder again")
        (event,) = events(t, FaultEvent.INTRUDER)
        assert event.robot == "robot_2"
        assert "/test_team (gid " in event.detail
        assert "publishes on /robot_2/command too (2 publishers)" in event.detail
        t.node.destroy_publisher(intruder)
        listener.status(1, lambda s: "somebody else" not in s.message, "its end")
        assert len(events(t, FaultEvent.INTRUDER)) == 1


def plan(revision: int, *faults: Fault) -> CrashPlan:
    return CrashPlan(revision=revision, cap=3, lease_s=30.0, faults=list(faults))


def test_plans_that_cannot_be_carried_out_are_refused_once(ros_env: dict[str, str]) -> None:
    with process(ros_env, "gate", robots=ROBOTS), team(ros_env) as t:
        t.meet(coach=False)
        publisher = t.node.create_publisher(CrashPlan, "/coach/plan", PLAN)
        t.until(lambda: publisher.get_subscription_count() >= 2, "the gate")
        publisher.publish(plan(1))
        t.until(lambda: t.armed() == [1], "the first plan")
        for revision, (fault, reason) in enumerate(
            [
                (Fault(robot="robot_1", mode="explode"), "unknown crash mode 'explode'"),
                (Fault(robot="robot_9", mode="mute"), "unknown robot 'robot_9'"),
                (Fault(robot="robot_1", mode="bias"), "crash mode bias needs"),
                (Fault(robot="robot_1", mode="blind"), "start it with relay_observations:=true"),
                (
                    Fault(
                        robot="robot_1",
                        mode="delay",
                        parameter_names=["steps"],
                        parameter_values=[0.0],
                    ),
                    "crash mode delay: parameter steps = 0.0",
                ),
                (Fault(robot="robot_1", mode="mute", trigger=2), "trigger NEAR has 0 values"),
            ],
            start=2,
        ):
            for _ in range(3):  # heartbeats
                publisher.publish(plan(revision, fault))
            t.until(lambda n=revision: any(e.revision == n for e in t.events), "an answer")
            t.serve(0.1)
            refused = [e for e in t.events if e.revision == revision]
            assert [e.kind for e in refused] == [FaultEvent.REFUSED]
            assert reason in refused[0].detail
        listener = Listener(t)
        listener.status(
            0, lambda s: "plan refused: " in s.message and reason in s.message, "the refusal"
        )
        publisher.publish(plan(99))
        listener.status(0, lambda s: "refused" not in s.message, "its end")
        assert not any(outcome.faulted for outcome in t.step(0, 0))


def test_observations_are_relayed_changed_and_repeated(ros_env: dict[str, str]) -> None:
    gate = {"relay_observations": True}
    config = {"victims": ("robot_1",), "crash_mode": "blind", "start_step": 1, "duration_steps": 1}
    with graph(ros_env, gate=gate, **config) as g:
        seen: list[Observation] = []
        topic = "/robot_1/observation_seen"
        g.team.node.create_subscription(Observation, topic, seen.append, NEWEST)
        g.team.until(lambda: g.team.node.count_publishers(topic) > 0, "the relayed observations")
        g.team.serve(0.2)
        sender = g.team.node.create_publisher(Observation, "/robot_1/observation", NEWEST)
        g.team.until(lambda: sender.get_subscription_count() > 0, "the gate")
        for step in range(3):
            g.team.announce(0, step)
            message = Observation(step=step, features=array("f", [1.0, step]))
            message.available_actions = array("B", [1, 1, 1, 1, 0])
            for count in (2 * step + 1, 2 * step + 2):  # once more, as the sim does
                end = time.monotonic() + 20
                while len(seen) < count:
                    assert time.monotonic() < end
                    sender.publish(message)
                    g.team.serve(0.3)
                assert np.array_equal(seen[-1].features, [0.0, 0.0] if step == 1 else [1.0, step])
                assert (seen[-1].step, list(seen[-1].available_actions)) == (step, [1, 1, 1, 1, 0])
        observed = {(e.step, e.mode, e.applied) for e in events(g, FaultEvent.EFFECT)}
        assert observed == {(1, "blind", FaultEvent.OBSERVED)}
        assert len(events(g, FaultEvent.EFFECT)) == 1


def test_observation_faults_are_refused_at_once_where_no_gate_relays_observations(
    ros_env: dict[str, str],
) -> None:
    with graph(ros_env) as g:
        g.team.step(0, 0)
        # The gate would be asked with the next episode only.
        reason = g.operator.set(victims=["robot_1"], crash_mode="blind", apply_at="next_episode")
        assert "fault blind changes observations, which this gate does not relay" in reason
        assert g.operator.get("crash_mode", "victims") == ["mute", ["none"]]
        assert not any(outcome.faulted for outcome in g.team.step(1, 0))
        assert FaultEvent.REFUSED not in g.team.kinds()


def test_observation_faults_are_taken_where_the_gate_relays_observations(
    ros_env: dict[str, str],
) -> None:
    with graph(ros_env, gate={"relay_observations": True}) as g:
        assert not g.operator.set(victims=["robot_1"], crash_mode="blind")


@pytest.mark.parametrize("mode", ["blind", "bias"])
def test_the_coach_hands_on_why_a_plan_was_refused(ros_env: dict[str, str], mode: str) -> None:
    with graph(ros_env) as g:
        g.team.step(0, 0)
        started = time.monotonic()
        reason = g.operator.set(victims=["robot_1"], crash_mode=mode, apply_at="next_step")
        assert time.monotonic() - started < 1.5, "it waited for an answer that was there"
        assert "relay_observations" in reason if mode == "blind" else "needs" in reason
        assert not any(outcome.faulted for outcome in g.team.step(0, 1))
