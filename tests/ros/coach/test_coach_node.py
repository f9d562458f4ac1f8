"""The coach as a process: its parameters, services and plans."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import pytest
from coach_graph import ROBOTS, Graph, Team, graph, operator, process, run_to_end, team
from crash_coach_interfaces.msg import CrashPlan, FaultEvent
from shared_memory import strike

from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.coach.live_coach import Control, ControlSettings
from crash_coach_pkg.coach.parameters import START_SPECS, parameter_specs
from crash_coach_pkg.team import TeamSpec


def new_plan(team: Team, wanted: Callable[[CrashPlan], bool], what: str) -> CrashPlan:
    team.until(lambda: bool(team.plans) and wanted(team.plans[-1]), what)
    return team.plans[-1]


def plan_of(g: Graph | Team, episode: int) -> CrashPlan:
    played = g.team if isinstance(g, Graph) else g
    return new_plan(played, lambda plan: plan.episode == episode, f"plan of episode {episode}")


def told(g: Graph, **values: object) -> str:
    """What the coach says to a change that it makes."""
    asked = g.operator.begin(**values)
    g.team.until(lambda: g.operator.poll(asked), "the coach's answer")
    result = asked.result().result
    assert result.successful
    return str(result.reason)


def victims(plan: CrashPlan) -> list[str]:
    return [fault.robot for fault in plan.faults]


def test_plans_equal_the_cores_and_heartbeats_repeat_them(ros_env: dict[str, str]) -> None:
    settings = {"strategy": "fixed", "crash_rate": 0.5, "cap_rule": "authors"}
    core = Coach(CoachConfig(**settings), TeamSpec(ROBOTS), seed=11)
    with process(ros_env, "coach", robots=ROBOTS, seed=11, **settings), team(ros_env) as t:
        t.meet(gate=False)
        for episode in range(12):
            t.announce(episode, 0)
            plan = plan_of(t, episode)
            expected = core.plan(episode)
            assert victims(plan) == [ROBOTS[fault.robot] for fault in expected.faults]
            assert (plan.rate, plan.cap, plan.seed) == (0.5, expected.cap, 11)
        t.plans.clear()
        told_s: list[float] = []

        def three_in_time() -> bool:  # lease_s is 1; a busy machine may miss it once
            told_s.extend([time.monotonic()] * (len(t.plans) - len(told_s)))
            return any(
                third - first <= 1.2 for first, third in zip(told_s[:-2], told_s[2:], strict=True)
            )

        t.until(three_in_time, "three heartbeats within 1.2 s")
        assert {plan.revision for plan in t.plans} == {plan.revision}


def test_every_parameter_is_described(ros_env: dict[str, str]) -> None:
    names = [spec.name for spec in (*parameter_specs(), *START_SPECS)]
    with process(ros_env, "coach", robots=ROBOTS), operator(ros_env) as setter:
        described = {d.name: d for d in setter.describe([*names, "robots"])}
        assert all(d.description for d in described.values())
        assert described["robots"].read_only
        assert all(described[spec.name].read_only for spec in START_SPECS)
        assert described["delay.steps"].integer_range[0].to_value == 1000
        assert "[m/s]" in described["bias.linear_x_m_s"].description
        assert described["crash_rate"].floating_point_range[0].to_value == 1.0
        assert described["lease_s"].floating_point_range[0].from_value == pytest.approx(0.2)
        assert described["crashed_exactly"].integer_range[0].from_value == -1
        assert described["seed"].integer_range[0].to_value == 2**63 - 1


BAD_SETS: list[tuple[dict[str, object], str]] = [
    ({"victims": ["robot_9"]}, "unknown robot 'robot_9'"),
    ({"victims": ["none", "robot_1"]}, "'none' stands alone"),
    ({"crash_rate": math.nan}, "crash_rate"),
    ({"crash_rate": 1.1}, "out of range"),
    ({"crash_rate": "much"}, "expected 'Type.DOUBLE' got 'Type.STRING'"),
    ({"min_alive": 4}, "min_alive 4 is more than the team's 3 robots"),
    ({"victims": ["robot_1", "robot_2"], "max_crashed": 1}, "victims asks for 2"),
    ({"victims": ["robot_1"], "crashed_exactly": 1}, "contradict"),
    ({"crash_rate": 0.4, "crash_mode": "explode"}, "crash_mode 'explode'"),
    ({"crash_rate": 0.4, "strategy": "wild"}, "unknown coaching strategy 'wild'"),
    ({"crash_rate": 0.4, "adaptive.rho": 0.0}, "setting rho = 0.0"),
    ({"victim_role": "scout"}, "'scout'; one of: this team has no roles"),
    ({"hazard_rate_hz": 0.5}, "dt_s is unknown"),
    ({"near_point_m": [1.0]}, "near_point_m [1.0]: x and y in metres"),
    ({"near_radius_m": -1.0}, "out of range"),
    ({"near_radius_m": 1.0, "return_above": 2.0}, "near_radius_m 1.0 and return_above 2.0"),
    ({"delay.steps": 0}, "out of range"),
    ({"noise.stddev": math.nan}, "noise.stddev out of range"),
    ({"fault_scenario": "one_mute"}, "read-only"),
    ({"apply_at": "at once"}, "apply_at 'at once'"),
    ({"lease_s": 0.0}, "out of range"),
    ({"seed": -1}, "out of range"),
    ({"robots": ["robot_1"]}, "read-only"),
    ({"nonsense": 1}, "coach has no parameter 'nonsense'"),
    ({"deck.tow": 1}, "has no parameter 'deck.tow' (did you mean 'deck.two'?)"),
]


def test_bad_parameters_are_refused_as_a_whole_with_the_reason(ros_env: dict[str, str]) -> None:
    names = [spec.name for spec in parameter_specs()]
    with process(ros_env, "coach", robots=ROBOTS), team(ros_env) as t, operator(ros_env) as setter:
        t.meet(gate=False)
        t.announce(0, 0)
        plan_of(t, 0)
        before = setter.get(*names)
        for values, reason in BAD_SETS:
            # Something good in the same call must not be applied either.
            answer = setter.set(**{"adaptive.beta": 0.5, **values})
            assert reason.lower() in answer.lower(), (values, answer)
            assert setter.get(*names) == before, values
        t.announce(1, 0)
        assert victims(plan_of(t, 1)) == []


def test_next_episode_leaves_the_running_one_alone(ros_env: dict[str, str]) -> None:
    with graph(ros_env) as g:
        g.team.step(0, 0)
        assert not g.operator.set(victims=["robot_1", "robot_3"])
        assert not any(outcome.faulted for outcome in g.team.step(0, 1))
        assert [outcome.faulted for outcome in g.team.step(1, 0)] == [True, False, True]
        assert not g.operator.set(victims=["none"])
        assert [outcome.faulted for outcome in g.team.step(1, 1)] == [True, False, True]
        assert not any(outcome.faulted for outcome in g.team.step(2, 0))


def test_clear_all_ends_every_fault_and_the_parameter_says_so(ros_env: dict[str, str]) -> None:
    with graph(ros_env, strategy="fixed", crash_rate=1.0) as g:
        assert all(outcome.faulted for outcome in g.team.step(0, 0))
        answer = g.operator.clear()
        assert answer.success
        assert "enabled is now false" in answer.message
        assert g.operator.get("enabled") == [False]
        assert not any(outcome.faulted for outcome in g.team.step(0, 1))
        assert FaultEvent.CLEARED in g.team.kinds()
        assert not any(outcome.faulted for outcome in g.team.step(1, 0))
        assert "enabled is false" in g.operator.set(victims=["robot_1"])
        assert not g.operator.set(enabled=True)
        assert all(outcome.faulted for outcome in g.team.step(2, 0))


def test_without_a_gate_an_injection_is_refused_and_undone(ros_env: dict[str, str]) -> None:
    with process(ros_env, "coach", robots=ROBOTS), team(ros_env) as t, operator(ros_env) as setter:
        t.meet(gate=False)
        assert not setter.set(apply_at="next_step")
        t.announce(0, 0)
        plan_of(t, 0)
        assert "no gate armed the plan within 5 s" in setter.set(victims=["robot_1"])
        assert setter.get("victims") == [["none"]]
        t.until(lambda: any(plan.faults for plan in t.plans), "the injection")
        newest = new_plan(t, lambda plan: not plan.faults, "the plan without the fault")
        t.serve(0.5)
        assert t.plans[-1].revision == newest.revision
        answer = setter.clear()
        assert not answer.success
        assert "no gate armed" in answer.message
        assert setter.get("enabled") == [False]


def test_an_injection_lasts_as_many_steps_as_asked_and_is_told_when_it_begins(
    ros_env: dict[str, str],
) -> None:
    with graph(ros_env) as g:
        first = "no episode has begun: it counts from the first one on"
        assert told(g, victims=["none"], apply_at="next_step") == first
        for step in range(5):
            g.team.step(0, step)
        begins = told(g, victims=["robot_2"], duration_steps=3)
        assert begins == "armed at step 5 of episode 0"
        faulted = [g.team.step(0, step)[1].faulted for step in range(5, 12)]
        assert faulted == [True] * 3 + [False] * 4
        # The same again is another injection.
        assert not g.operator.set(victims=["robot_2"])
        assert g.team.step(0, 12)[1].faulted


def live_rates(ros_env: dict[str, str], successes: list[int], **settings: object) -> list[float]:
    """The crash rate of each episode's plan, for episodes that end so one after another."""
    rates = []
    with process(ros_env, "coach", robots=ROBOTS, **settings), team(ros_env) as t:
        t.meet(gate=False)
        for episode, success in enumerate(successes):
            t.announce(episode, 0)
            rates.append(plan_of(t, episode).rate)
            t.announce(episode, 1, ended=True, success=bool(success))
    return rates


def test_adaptive_follows_complete_blocks_of_live_episodes(ros_env: dict[str, str]) -> None:
    settings = {
        "strategy": "adaptive",
        "adaptive.beta": 0.5,
        "adaptive.rho": 0.25,
        "block_episodes": 2,
    }
    rates = live_rates(ros_env, [1, 1, 1, 0, 0, 0, 1], **settings)
    # Blocks: (1, 1) -> .25, (1, 0) -> .4375, (0, 0) -> .328125
    assert rates == [0, 0, 0.25, 0.25, 0.4375, 0.4375, 0.328125]


def test_patient_waits_for_a_block_of_live_episodes(ros_env: dict[str, str]) -> None:
    settings = {
        "strategy": "patient",
        "patient.success": 1.0,
        "crash_rate": 0.25,
        "block_episodes": 2,
    }
    rates = live_rates(ros_env, [1, 0, 1, 1, 0, 0, 0], **settings)
    assert rates == [0, 0, 0, 0, 0.25, 0.25, 0.25]


def test_curriculum_follows_finished_episodes(ros_env: dict[str, str]) -> None:
    settings = {"strategy": "curriculum", "curriculum.alpha_max": 0.4, "curriculum.episodes": 4}
    rates = live_rates(ros_env, [0] * 6, **settings)
    assert rates == pytest.approx([0, 0.1, 0.2, 0.3, 0.4, 0.4])


@pytest.mark.parametrize(
    ("strategy", "changed"),
    [
        ("deck", {"deck.one": 4}),
        ("learnability", {"learnability.even": 0.25}),
        ("failure", {"failure.floor": 0.3}),
    ],
)
def test_who_is_chosen_follows_the_episodes_that_were_seen(
    ros_env: dict[str, str], strategy: str, changed: dict[str, Any]
) -> None:
    """Live episodes teach the coach's own memory, as the trainer's do; a setting that changes in
    between counts from the next episode, and what was learned stays."""
    settings = {"strategy": strategy, "min_alive": 1}
    control = Control(
        ControlSettings(seed=11, coach=CoachConfig(**settings)), TeamSpec(ROBOTS), revision=0
    )
    seen = []
    with process(ros_env, "coach", robots=ROBOTS, seed=11, **settings) as _, team(ros_env) as t:
        t.meet(gate=False)
        with operator(ros_env) as setter:
            for episode in range(24):
                if episode == 12:
                    assert not setter.set(**changed)
                    config = CoachConfig(
                        **settings, **{strategy: {k.split(".")[1]: v for k, v in changed.items()}}
                    )
                    control.configure(ControlSettings(seed=11, coach=config), now=False)
                t.announce(episode, 0)
                expected = control.follow(episode)
                assert expected is not None
                crashed = [ROBOTS[fault.robot] for fault in expected.faults]
                plan = plan_of(t, episode)
                assert victims(plan) == crashed, episode
                assert plan.rate == pytest.approx(control.rate)
                success = "robot_1" not in crashed
                t.announce(episode, 1, ended=True, success=success)
                control.finish(success)
                seen.append(tuple(crashed))
    assert {(), ("robot_1",), ("robot_2",), ("robot_1", "robot_2")} <= set(seen)


def test_a_coach_that_starts_in_mid_episode_plans_it(ros_env: dict[str, str]) -> None:
    with process(ros_env, "gate", robots=ROBOTS, first_lease_s=0.2), team(ros_env) as t:
        t.meet(coach=False)
        for step in range(4):
            assert not any(outcome.faulted for outcome in t.step(0, step))
        with process(ros_env, "coach", robots=ROBOTS, victims=("robot_1",)) as child:
            t.until(lambda: FaultEvent.ARMED in t.kinds(), "the new coach's plan armed")
            assert t.step(0, 4)[0].faulted
            strike(child.pid)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({}, "parameter 'robots' of coach is missing"),
        (
            {"robots": ROBOTS, "crash_rte": 0.1},
            "unknown parameter 'crash_rte' (did you mean 'crash_rate'?) of coach; known: ",
        ),
        ({"robots": ROBOTS, "crash_rate": 2.0}, "crash_rate"),
        ({"robots": ROBOTS, "victims": ("robot_7",)}, "unknown robot 'robot_7'"),
    ],
)
def test_bad_parameters_at_start_end_it_with_one_line(
    ros_env: dict[str, str], parameters: dict[str, object], message: str
) -> None:
    code, errors = run_to_end(ros_env, "coach", **parameters)
    assert code == 1
    assert message in errors
    assert errors.startswith("coach: error: ")
    assert errors.count("\n") == 1
