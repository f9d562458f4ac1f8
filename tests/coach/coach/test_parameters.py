"""The coach node's parameters, without ROS: one for every setting, bad values refused."""

from __future__ import annotations

from typing import Any

import pytest

from crash_coach_common.contract import UserError
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.coach.live_coach import ControlSettings
from crash_coach_pkg.coach.parameters import (
    START_SPECS,
    build_settings,
    build_team,
    check_beside,
    check_change,
    counts_now,
    parameter_specs,
)
from crash_coach_pkg.coach.strategies import find_strategy, strategy_names
from crash_coach_pkg.faults import fault_mode, mode_names
from crash_coach_pkg.team import TeamSpec

TEAM = TeamSpec(("robot_1", "robot_2", "robot_3"), ("scout", "scout", "hauler"), 0.1)
DEFAULTS = {spec.name: spec.default for spec in parameter_specs()}


def settings(**values: Any) -> ControlSettings:
    return build_settings({**DEFAULTS, **values}, TEAM)


def test_every_setting_is_a_parameter_with_a_description() -> None:
    of_modes = [
        f"{mode}.{name}"
        for mode in mode_names()
        for name in fault_mode(mode).Parameters.model_fields
    ]
    of_strategies = [
        f"{strategy}.{name}"
        for strategy in strategy_names()
        for name in find_strategy(strategy).Settings.model_fields
    ]
    assert "delay.steps" in of_modes
    assert {"adaptive.beta", "deck.two", "failure.floor"} < set(of_strategies)
    names = [spec.name for spec in parameter_specs()]
    assert len(set(names)) == len(names)
    assert set(names) == {
        "enabled", "strategy", "crash_rate", "crash_mode", "victims", "start_step",
        "duration_steps", "max_crashed", "min_alive", "seed",
        "apply_at", "lease_s", "resample", "cap_rule", "crashed_exactly", "block_episodes",
        "victim_role", "hazard_rate_hz", "near_point_m", "near_radius_m",
        "return_above", "success_from", *of_modes, *of_strategies,
    }  # fmt: skip
    for spec in parameter_specs():
        assert spec.description
        numeric = isinstance(spec.default, int | float) and not isinstance(spec.default, bool)
        assert numeric == (spec.low is not None and spec.high is not None), spec.name
        if spec.low is not None and spec.high is not None:
            assert isinstance(spec.default, int | float)
            assert spec.low <= spec.default <= spec.high


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"victims": ("robot_4",)}, "unknown robot 'robot_4' in victims; one of: robot_1"),
        ({"victims": ("none", "robot_1")}, "'none' stands alone"),
        ({"victims": ("robot_1", "robot_1")}, "more than once"),
        ({"victims": ()}, None),
        ({"crash_rate": float("nan")}, "crash_rate nan: .*finite"),
        ({"crash_rate": 1.5}, "crash_rate 1.5: .*less than or equal to 1"),
        ({"adaptive.rho": 0.0}, "strategy adaptive: setting rho = 0.0: .*greater than 0"),
        ({"adaptive.alpha_max": -0.5}, "setting alpha_max = -0.5: .*greater than or equal to 0"),
        ({"deck.nobody": 0, "deck.one": 0, "deck.two": 0}, "strategy deck: a deck without cards"),
        ({"strategy": "curriculum"}, "length of training is unknown here; set curriculum.episodes"),
        ({"curriculum.episodes": 5, "strategy": "curriculum"}, None),
        ({"crash_mode": "explode"}, "crash_mode 'explode': unknown crash mode .* mute, ra"),
        ({"victims": "robot_1"}, "victims 'robot_1' is not a list of names"),
        ({"victim_role": "cook"}, "unknown victim_role 'cook'; one of: scout, hauler"),
        ({"victim_role": "hauler", "victims": ("robot_1",)}, "contradict"),
        ({"hazard_rate_hz": 0.5, "return_above": 3.0}, "hazard_rate_hz 0.5 and return_above 3.0"),
        ({"near_point_m": (1.0,)}, r"near_point_m \[1.0\]: x and y in metres"),
        ({"near_point_m": (1.0, float("nan"))}, r"near_point_m \[1.0, nan\]"),
        ({"near_point_m": (1.0, 2.0)}, None),  # the radius may come later
        ({"return_above": float("nan")}, "return_above nan: .*finite"),
        ({"noise.stddev": float("nan")}, "crash mode noise: parameter stddev = nan"),
        ({"delay.steps": 0}, "crash mode delay: parameter steps = 0.0: .*greater than"),
        ({"crash_mode": "delay", "delay.steps": 7}, None),
        ({"strategy": "wild"}, "unknown coaching strategy 'wild'"),
        ({"apply_at": "later"}, "apply_at 'later': .*'next_step'"),
        ({"min_alive": 4}, "min_alive 4 is more than the team's 3 robots"),
        ({"victims": ("robot_1", "robot_2"), "max_crashed": 1}, "victims asks for 2"),
        ({"victims": ("robot_1",), "crashed_exactly": 1}, "contradict"),
    ],
)
def test_a_wrong_configuration_is_refused_with_the_reason(
    values: dict[str, Any], message: str | None
) -> None:
    if message is None:
        settings(**values)
        return
    with pytest.raises(UserError, match=message):
        settings(**values)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"enabled": False, "victims": ("robot_1",)}, None),  # as a file of all parameters says
        ({"victims": ("robot_1",), "strategy": "none"}, None),
        ({"crashed_exactly": 1, "strategy": "none"}, None),
        ({"victims": ("none",), "enabled": False}, None),
        ({"victims": ("robot_1",), "enabled": True}, None),
    ],
)
def test_a_change_without_effect_is_refused(values: dict[str, Any], message: str | None) -> None:
    if message is None:
        check_change(settings(**values), tuple(values))
        return
    with pytest.raises(UserError, match=message):
        check_change(settings(**values), tuple(values))


@pytest.mark.parametrize(
    ("before", "change", "message"),
    [
        ({"enabled": False}, {"victims": ("robot_1",)}, "victims would have no effect: enabled"),
        ({"enabled": False}, {"crashed_exactly": 1}, "crashed_exactly would have no effect"),
        ({"strategy": "none"}, {"crashed_exactly": 1}, "crashed_exactly .* strategy is none"),
    ],
)
def test_a_change_that_cannot_take_effect_is_refused(
    before: dict[str, Any], change: dict[str, Any], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        check_change(settings(**before, **change), tuple(change))


def test_enumerated_parameters_list_their_choices() -> None:
    choices = {spec.name: spec.choices for spec in parameter_specs() if spec.choices}
    assert set(choices) == {"apply_at", "success_from", "crash_mode", "strategy", "cap_rule"}
    assert choices["apply_at"] == ("next_episode", "next_step")
    assert {"mute", "stay", "blind"} <= set(choices["crash_mode"])
    for spec in parameter_specs():
        assert not spec.choices or spec.default in spec.choices


def test_the_chosen_modes_parameters_count() -> None:
    values: dict[str, Any] = {"delay.steps": 7, "noise.stddev": 0.5}
    assert settings(**values).coach.crash_parameters == {}
    assert settings(**values, crash_mode="delay").coach.crash_parameters == {"steps": 7}
    assert settings(**values, crash_mode="noise").coach.crash_parameters == {"stddev": 0.5}


def test_the_chosen_strategys_settings_count() -> None:
    values: dict[str, Any] = {"adaptive.rho": 0.5, "deck.two": 4}
    assert settings(**values).coach == settings().coach
    assert settings(**values, strategy="deck").coach.settings.model_dump() == {
        "nobody": 2, "one": 2, "two": 4, "three": 0,
    }  # fmt: skip
    adaptive = settings(**values, strategy="adaptive").coach
    assert adaptive == CoachConfig(strategy="adaptive", adaptive={"rho": 0.5})


def test_what_ros_cannot_say_has_a_value_of_its_own() -> None:
    off = settings().coach
    assert (off.victims, off.return_above, off.triggered) == ((), None, False)
    near = settings(near_point_m=(1.0, -2.0), near_radius_m=0.5).coach
    assert (near.near_point_m, near.near_radius_m) == ((1.0, -2.0), 0.5)
    assert settings(return_above=-5.0).coach.return_above == -5.0


@pytest.mark.parametrize(
    ("changed", "values", "now"),
    [
        ({"victims"}, {}, False),
        ({"victims"}, {"apply_at": "next_step"}, True),
        ({"lease_s", "apply_at"}, {"apply_at": "next_step"}, False),
        (set(), {"apply_at": "next_step"}, False),
        ({"delay.steps"}, {"apply_at": "next_step"}, False),
        ({"delay.steps"}, {"apply_at": "next_step", "crash_mode": "delay"}, True),
        ({"deck.two"}, {"apply_at": "next_step"}, False),
        ({"deck.two"}, {"apply_at": "next_step", "strategy": "deck"}, True),
    ],
)
def test_which_changes_concern_the_running_episode(
    changed: set[str], values: dict[str, Any], now: bool
) -> None:
    assert counts_now(settings(**values), changed, endless=False) is now
    assert counts_now(settings(), {"victims"}, endless=True)


def test_beside_a_fault_scenario_only_switches_can_be_set() -> None:
    check_beside("", ("victims",))
    check_beside("one_mute", ("enabled", "lease_s", "apply_at", "use_sim_time"))
    for name in ("victims", "crash_mode", "seed", "delay.steps"):
        with pytest.raises(UserError, match=f"{name} would have no effect: fault_scenario one_mu"):
            check_beside("one_mute", ("enabled", name))


def test_the_team_of_the_parameters_at_start() -> None:
    start = {spec.name: spec.default for spec in START_SPECS}
    robots = TEAM.robots
    assert build_team(start, robots) == TeamSpec(robots)
    given = {**start, "roles": TEAM.roles, "dt_s": 0.1}
    assert build_team(given, robots) == TEAM
    with pytest.raises(UserError, match="1 for 3 robots"):
        build_team({**start, "roles": ("scout",)}, robots)
    assert all(spec.read_only and spec.description for spec in START_SPECS)
