"""Whom a fault concerns and what starts it, against hand-worked cases and the laws of draws."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from crash_coach_common.contract import UserError
from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.config import CoachConfig, FaultConfig
from crash_coach_pkg.coach.draws import check_team, draw_faults, draw_victims
from crash_coach_pkg.plan import Trigger, TriggerKind
from crash_coach_pkg.schedule import Schedule
from crash_coach_pkg.team import TeamSpec
from sim_pkg.env import make_env

ROBOTS = tuple(f"robot_{i + 1}" for i in range(5))
ROLES = ("scout", "hauler", "scout", "hauler", "scout")
TEAM = TeamSpec(ROBOTS, ROLES, dt_s=0.1)
SCOUTS = {0, 2, 4}


def victims(seed: int = 0, team: TeamSpec = TEAM, **settings: Any) -> set[int]:
    mask = draw_victims(FaultConfig(**settings), team, np.random.default_rng(seed))
    assert mask.shape == (team.n,)
    return set(np.flatnonzero(mask).tolist())


def plans(episodes: int = 200, **settings: Any) -> list[set[int]]:
    coach = Coach(CoachConfig(strategy="fixed", **settings), TEAM, seed=3)
    return [{fault.robot for fault in coach.plan(episode).faults} for episode in range(episodes)]


def test_by_name_by_role_and_everybody() -> None:
    assert victims(victims=("robot_4", "robot_1")) == {0, 3}
    assert victims(victim_role="scout") == SCOUTS
    assert victims() == {0, 1, 2, 3, 4}
    assert victims(team=TeamSpec(ROBOTS)) == {0, 1, 2, 3, 4}


def test_k_of_a_role_is_uniform(fits: Callable[..., bool]) -> None:
    drawn = [tuple(victims(seed, victim_role="scout", crashed_exactly=2)) for seed in range(900)]
    assert set(drawn) == {(0, 2), (0, 4), (2, 4)}
    assert fits([drawn.count(pair) for pair in set(drawn)], 300)


def test_everybody_stays_within_the_limits_unless_the_schedule_keeps_them() -> None:
    assert {len(victims(seed, min_alive=2)) for seed in range(20)} == {3}
    assert {len(victims(seed, max_crashed=1)) for seed in range(20)} == {1}
    assert victims(max_crashed=1, hazard_rate_hz=1.0) == {0, 1, 2, 3, 4}


def test_crash_rates_concern_the_robots_of_the_role_only() -> None:
    drawn = plans(1500, victim_role="scout", crash_rate=0.4, resample=False)
    assert set().union(*drawn) == SCOUTS
    mean = sum(len(robots) for robots in drawn) / len(drawn)
    assert mean == pytest.approx(1.2, abs=4 * math.sqrt(3 * 0.4 * 0.6 / 1500))
    # The cap counts them too: ceil (3 x 0.4) = 2, less where the whole team's limit is lower.
    assert max(map(len, plans(300, victim_role="scout", crash_rate=0.4))) == 2
    assert max(map(len, plans(300, victim_role="scout", crash_rate=0.9, min_alive=4))) == 1


def test_without_a_role_the_draw_is_what_it_always_was() -> None:
    """Figures of published runs depend on it."""
    coach = Coach(CoachConfig(strategy="fixed", crash_rate=0.5), TeamSpec(ROBOTS), seed=4)
    drawn = [tuple(f.robot for f in coach.plan(e).faults) for e in range(6)]
    assert drawn == GOLDEN


GOLDEN = [(0, 3, 4), (1, 2, 4), (0, 1, 2), (1, 2), (3,), (1,)]


def test_a_hazard_strikes_with_one_minus_exp() -> None:
    (fault,) = draw_faults(
        FaultConfig(victims=("robot_1",), hazard_rate_hz=2.0, duration_steps=3),
        TEAM,
        np.array([True, False, False, False, False]),
        entry=7,
    )
    assert fault.trigger.kind == TriggerKind.HAZARD
    assert fault.trigger.values == pytest.approx((1 - math.exp(-0.2),))
    assert (fault.duration_steps, fault.entry) == (3, 7)


def test_a_hazards_mean_waiting_time_is_one_over_the_rate() -> None:
    coach = Coach(CoachConfig(strategy="fixed", hazard_rate_hz=2.0), TEAM, seed=0)
    steps = []
    for episode in range(300):
        schedule = Schedule(coach.plan(episode))
        started: set[int] = set()
        for step in range(200):
            schedule.enter(step, None)
            new = set(schedule.in_force) - started
            started |= new
            steps += [step] * len(new)
    # Geometric: mean (1 - p) / p steps.
    p = 1 - math.exp(-0.2)
    error = 4 * math.sqrt((1 - p) / p**2 / len(steps))
    assert np.mean(steps) == pytest.approx((1 - p) / p, abs=error)


@pytest.mark.parametrize(
    ("settings", "trigger"),
    [
        ({}, Trigger()),
        (
            {"near_point_m": (1.0, -2.0), "near_radius_m": 0.5},
            Trigger(TriggerKind.NEAR, (1.0, -2.0, 0.5)),
        ),
        ({"return_above": -3.0}, Trigger(TriggerKind.RETURN_ABOVE, (-3.0,))),
        ({"return_above": 0.0}, Trigger(TriggerKind.RETURN_ABOVE, (0.0,))),
    ],
)
def test_conditions(settings: dict[str, Any], trigger: Trigger) -> None:
    plan = Coach(CoachConfig(strategy="fixed", victims=("robot_2",), **settings), TEAM, 0).plan(0)
    assert [(fault.robot, fault.trigger) for fault in plan.faults] == [(1, trigger)]


def test_with_a_condition_and_no_rate_everybody_can_be_struck_up_to_the_limit() -> None:
    settings = {"hazard_rate_hz": 0.1, "min_alive": 2}
    plan = Coach(CoachConfig(strategy="fixed", **settings), TEAM, seed=0).plan(0)
    assert ({fault.robot for fault in plan.faults}, plan.cap) == ({0, 1, 2, 3, 4}, 3)
    assert all(robots == SCOUTS for robots in plans(5, victim_role="scout", return_above=1.0))
    # A rate draws the candidates first; a rate that is 0 for now strikes nobody.
    assert 0 < sum(map(len, plans(50, hazard_rate_hz=0.1, crash_rate=0.3))) < 5 * 50
    adaptive = Coach(CoachConfig(strategy="adaptive", hazard_rate_hz=0.1), TEAM, seed=0)
    assert not adaptive.plan(0).faults
    none = Coach(CoachConfig(strategy="none", hazard_rate_hz=0.1), TEAM, seed=0)
    assert not none.plan(0).faults


def test_mode_and_parameters_reach_the_plan_under_the_modes_own_name() -> None:
    config = CoachConfig(
        strategy="fixed", victims=("robot_1",), crash_mode="drop",
        crash_parameters={"to_good": 0.5, "probability": 0.25},
    )  # fmt: skip
    (fault,) = Coach(config, TEAM, 0).plan(0).faults
    assert (fault.mode, fault.parameters) == ("drop", (("probability", 0.25), ("to_good", 0.5)))
    (stays,) = (
        Coach(CoachConfig(strategy="fixed", victims=("robot_1",), crash_mode="stay"), TEAM, 0)
        .plan(0)
        .faults
    )
    assert stays.mode == "mute"


@given(
    st.integers(-1, 5), st.integers(0, 5), st.floats(0, 1), st.sampled_from(["", "scout", "hauler"])
)
def test_limits_hold_for_every_draw(
    max_crashed: int, min_alive: int, rate: float, role: str
) -> None:
    config = CoachConfig(
        strategy="fixed", crash_rate=rate, max_crashed=max_crashed, min_alive=min_alive,
        victim_role=role, resample=False,
    )  # fmt: skip
    coach = Coach(config, TEAM, seed=1)
    for episode in range(5):
        plan = coach.plan(episode)
        assert len(plan.faults) <= plan.cap
        assert TEAM.n - len(plan.faults) >= min_alive
        assert max_crashed < 0 or len(plan.faults) <= max_crashed


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"victim_role": "cook"}, "unknown victim_role 'cook'; one of: scout, hauler"),
        ({"victim_role": "hauler", "crashed_exactly": 3}, "3 crashed robots; .* 2 .*'hauler'"),
        ({"crashed_exactly": 6}, "crashed_exactly asks for 6 .* 5 robots"),
    ],
)
def test_what_a_team_cannot_keep(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        check_team(FaultConfig(**settings), TEAM)


def test_a_team_without_roles_or_step_length_says_so() -> None:
    bare = TeamSpec(ROBOTS)
    with pytest.raises(UserError, match="'scout'; one of: this team has no roles"):
        check_team(FaultConfig(victim_role="scout"), bare)
    with pytest.raises(UserError, match=r"hazard_rate_hz needs .*dt_s is unknown"):
        check_team(FaultConfig(hazard_rate_hz=0.1), bare)
    check_team(FaultConfig(hazard_rate_hz=0.0), bare)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"hazard_rate_hz": 1.0, "near_radius_m": 1.0}, "hazard_rate_hz 1.0 and near_radius_m 1.0"),
        ({"near_radius_m": 1.0, "return_above": 2.0}, "near_radius_m 1.0 and return_above 2.0"),
        ({"near_point_m": (1.0, 0.0)}, "no effect without near_radius_m"),
        ({"victims": ("robot_1",), "victim_role": "scout"}, "victims .* and victim_role"),
        ({"crash_mode": "explode"}, "crash_mode\n.*unknown crash mode 'explode'; one of: mute"),
        ({"crash_mode": "delay", "crash_parameters": {"stps": 3}}, "stps.*its parameters: steps"),
        ({"crash_parameters": {"steps": 3}}, "crash mode mute: .*its parameters: none"),
        ({"hazard_rate_hz": -1.0}, "hazard_rate_hz"),
        ({"hazard_rate_hz": math.inf}, "hazard_rate_hz"),
        ({"near_point_m": (0.0,), "near_radius_m": 1.0}, "near_point_m"),
        ({"near_radius_m": math.nan}, "near_radius_m"),
        ({"return_above": math.nan}, "return_above"),
        ({"duration_steps": -1}, "duration_steps"),
    ],
)
def test_settings_that_make_no_sense(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        FaultConfig(**settings)


@pytest.mark.parametrize(
    ("given_", "message"),
    [
        ({"roles": ("scout",)}, "1 for 5 robots"),
        ({"dt_s": 0.0}, "dt_s 0.0"),
        ({"dt_s": math.nan}, "dt_s nan"),
    ],
)
def test_teams_that_make_no_sense(given_: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        TeamSpec(ROBOTS, **given_)


def test_the_team_of_a_scenario() -> None:
    spec = make_env("buttons", 1).spec
    assert TeamSpec.of(spec) == TeamSpec(spec.robots, spec.roles, spec.dt_s)
