"""The coach in a live graph: hand-over to a new one, refusals of the gate, scenarios, no sim."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from coach_graph import ROBOTS, Team, graph, operator, process, run_to_end, team
from crash_coach_interfaces.msg import Action, CrashPlan, Fault, FaultEvent
from shared_memory import strike

from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.coach.fault_scenario import (
    ScenarioPlanner,
    find_fault_scenario,
    load_fault_scenario,
)
from crash_coach_pkg.gate.action_gate import GateState
from crash_coach_pkg.gate.messages import Command, Decision
from crash_coach_pkg.team import TeamSpec

SEED = 5
STEPS = 24
DROP = {"probability": 0.2, "to_bad": 0.3, "to_good": 0.3}


def in_core(steps: int) -> list[list[int]]:
    """What each robot gets in each step of episode 0, -1 for nothing, without any hand-over."""
    config = CoachConfig(
        strategy="fixed",
        victims=("robot_1", "robot_3"),
        crash_mode="drop",
        crash_parameters=DROP,
    )
    gate = GateState(len(ROBOTS), lockstep=True, first_lease_s=10.0)
    gate.plan(Coach(config, TeamSpec(ROBOTS), SEED).plan(0), 10.0, 0.0)
    got = []
    for step in range(steps):
        row = []
        for robot in range(len(ROBOTS)):
            outputs = gate.command(Command(robot, 0, step, (step + robot) % 5), 0.0)
            row += [out.applied for out in outputs if isinstance(out, Decision)]
        got.append(row)
    return got


def played(t: Team, steps: range) -> list[list[int]]:
    """The same over ROS."""
    got = []
    for step in steps:
        commands = [outcome.command for outcome in t.step(0, step)]
        got.append([-1 if c is None else c.action for c in commands])
    return got


def armed(t: Team, newer_than: int) -> bool:
    return any(revision > newer_than for revision in t.armed())


def test_a_killed_coach_that_is_back_within_the_lease_goes_on_without_a_jump(
    ros_env: dict[str, str],
) -> None:
    expected = in_core(STEPS)
    flat = np.array(expected)
    assert 0 < (flat[:, [0, 2]] == -1).sum() < 2 * STEPS
    drop = {f"drop.{name}": value for name, value in DROP.items()}
    fault = {"victims": ("robot_1", "robot_3"), "crash_mode": "drop", "seed": SEED, **drop}
    with graph(ros_env, lease_s=20.0, **fault) as g:
        half = STEPS // 2
        assert played(g.team, range(half)) == expected[:half]
        first = g.team.plans[-1]
        strike(g.coach.pid)
        g.coach.wait(timeout=10)
        # Its own settings, which count from the next episode on: robot_2 is mute.
        with process(ros_env, "coach", robots=ROBOTS, lease_s=20.0, victims=("robot_2",)):
            g.team.until(lambda: armed(g.team, first.revision), "the new coach's plan")
            assert played(g.team, range(half, STEPS)) == expected[half:]
            second = g.team.plans[-1]
            assert (second.episode, second.seed, second.faults) == (0, SEED, first.faults)
            kinds = g.team.kinds()
            assert kinds.count(FaultEvent.ARMED) == 2
            assert kinds.count(FaultEvent.ACTIVE) == 2  # one for each victim, not again
            assert {FaultEvent.CLEARED, FaultEvent.EXPIRED, FaultEvent.REFUSED}.isdisjoint(kinds)
            assert [outcome.faulted for outcome in g.team.step(1, 0)] == [False, True, False]


def test_a_gates_refusal_is_the_answer_and_the_running_fault_goes_on(
    ros_env: dict[str, str],
) -> None:
    with graph(ros_env) as g:
        for step in range(3):
            g.team.step(0, step)
        injection = {"victims": ["robot_2"], "duration_steps": 6, "apply_at": "next_step"}
        assert not g.operator.set(**injection)
        faulted = [g.team.step(0, step)[1].faulted for step in range(3, 6)]
        began_s = time.monotonic()
        answer = g.operator.set(crash_mode="bias", victims=["robot_1"])
        assert time.monotonic() - began_s < 1.5  # no time-out
        assert answer.startswith("the gate refused: ")
        assert "needs" in answer
        assert g.operator.get("crash_mode", "victims") == ["mute", ["robot_2"]]
        outcomes = [g.team.step(0, step) for step in range(6, 12)]
        faulted += [outcome[1].faulted for outcome in outcomes]
        assert faulted == [True] * 6 + [False] * 3
        assert not any(outcome[0].faulted for outcome in outcomes)
        assert FaultEvent.REFUSED in g.team.kinds()


def test_settings_of_a_mode_and_conditions_reach_the_plan(ros_env: dict[str, str]) -> None:
    own = {"roles": ("scout", "scout", "hauler"), "dt_s": 0.1}
    with (
        process(ros_env, "coach", robots=ROBOTS, **own),
        team(ros_env) as t,
        operator(ros_env) as setter,
    ):
        t.meet(gate=False)
        values: dict[str, Any] = {"crash_mode": "delay", "delay.steps": 7, "hazard_rate_hz": 2.0}
        assert not setter.set(**values, victim_role="scout", duration_steps=4)
        t.announce(0, 0)
        t.until(lambda: bool(t.plans), "a plan")
        faults = t.plans[-1].faults
        assert [fault.robot for fault in faults] == ["robot_1", "robot_2"]
        for fault in faults:
            assert (fault.mode, fault.duration_steps) == ("delay", 4)
            assert (list(fault.parameter_names), list(fault.parameter_values)) == (["steps"], [7.0])
            assert fault.trigger == Fault.HAZARD
            np.testing.assert_allclose(fault.trigger_values, [1 - np.exp(-0.2)])
        assert "hazard_rate_hz 2.0 and return_above 3.0" in setter.set(return_above=3.0)
        assert not setter.set(hazard_rate_hz=0.0, near_point_m=[1.0, 2.0])
        assert not setter.set(near_radius_m=0.5)
        assert "unknown victim_role 'cook'; one of: scout, hauler" in setter.set(victim_role="cook")


def test_a_fault_scenario_decides_instead_of_the_parameters(ros_env: dict[str, str]) -> None:
    scenario = load_fault_scenario(find_fault_scenario("one_mute"))
    planner = ScenarioPlanner(scenario, TeamSpec(ROBOTS), SEED)
    own = {"fault_scenario": "one_mute", "seed": SEED, "victims": ("robot_1",)}
    with (
        process(ros_env, "coach", robots=ROBOTS, **own),
        team(ros_env) as t,
        operator(ros_env) as setter,
    ):
        t.meet(gate=False)
        for episode in range(6):
            t.announce(episode, 0)
            t.until(lambda e=episode: bool(t.plans) and t.plans[-1].episode == e, "a plan")  # type: ignore[misc]
            expected = planner.plan(episode)
            assert [ROBOTS.index(f.robot) for f in t.plans[-1].faults] == [
                fault.robot for fault in expected.faults
            ]
        reason = setter.set(victims=["robot_2"])
        assert reason.startswith("victims would have no effect: fault_scenario one_mute decides")
        assert not setter.set(enabled=False)
        t.announce(6, 0)
        t.until(lambda: t.plans[-1].episode == 6, "a plan")
        assert not t.plans[-1].faults


def test_a_wrong_fault_scenario_ends_it_with_one_line(ros_env: dict[str, str]) -> None:
    code, errors = run_to_end(ros_env, "coach", robots=ROBOTS, fault_scenario="one_mut")
    assert code == 1
    assert errors.startswith("coach: error: unknown fault scenario 'one_mut'")
    assert errors.count("\n") == 1


def test_without_a_sim_one_endless_episode_starts_at_once(ros_env: dict[str, str]) -> None:
    with graph(ros_env, lockstep=False, follow_sim=False) as g:
        # Not until it is armed: that may have been told before this node listened.
        g.team.until(lambda: bool(g.team.plans), "a plan")
        assert (g.team.plans[-1].episode, len(g.team.plans[-1].faults)) == (0, 0)
        g.team.step(0, 0)
        assert not g.operator.set(victims=["robot_3"], duration_steps=2)  # though next_episode
        newest: CrashPlan = g.team.plans[-1]
        assert newest.episode == 0
        rows = [g.team.step(0, step) for step in range(1, 5)]
        assert [row[2].faulted for row in rows] == [True, True, False, False]
        assert rows[0][2].command is None
        assert isinstance(rows[0][0].command, Action)
