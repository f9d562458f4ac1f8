"""Fault scenario files: what is refused, with which line; plans that follow from a file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crash_coach_common.contract import UserError
from crash_coach_pkg.coach.fault_scenario import (
    FaultScenario,
    ScenarioPlanner,
    fault_scenario_names,
    find_fault_scenario,
    load_fault_scenario,
)
from crash_coach_pkg.plan import CrashPlan, TriggerKind
from crash_coach_pkg.schedule import Schedule
from crash_coach_pkg.team import TeamSpec

TEAM = TeamSpec(
    ("robot_1", "robot_2", "robot_3", "robot_4"), ("scout", "scout", "lifter", "lifter"), 0.5
)
LIMIT = 20


def scenario(folder: Path, text: str) -> FaultScenario:
    path = folder / "faults.yaml"
    path.write_text(text)
    return load_fault_scenario(path)


def file_of(*entries: str, expect: str = "") -> str:
    """A file in which the first key of entry i stands in line 3 + (lines before)."""
    return "description: d\nfaults:\n" + "".join(f"  - {entry}\n" for entry in entries) + expect


@pytest.mark.parametrize(
    ("text", "line", "names"),
    [
        (file_of("crash_mode: mut"), 3, "unknown crash mode 'mut'; one of: mute, random"),
        (file_of("crash_mod: mute"), 3, r"did you mean 'crash_mode'\?"),
        (file_of("crash_mode: mute", "start: 3"), 4, "unknown key 'faults.1.start'"),
        (
            file_of("crash_mode: delay\n    crash_parameters: {steps: 0}"),
            4,
            "parameter steps = 0.*greater than or equal to 1",
        ),
        (
            file_of("crash_mode: delay\n    crash_parameters: {step: 1}"),
            4,
            r"no parameter 'step' \(did you mean 'steps'\?\) \(its parameters: steps\)",
        ),
        (file_of("victims: [robot_1, robot_1]"), 3, "robot_1 more than once"),
        (file_of("{hazard_rate_hz: 1, return_above: 3}"), 3, "contradict each other"),
        (
            file_of("crash_mode: mute", expect="expect:\n  - sucess_rate: {at_least: 1}\n"),
            5,
            r"unknown key 'expect.0.sucess_rate' \(did you mean 'success_rate'\?\)",
        ),
        (
            file_of("crash_mode: mute", expect="expect:\n  - effects:\n      at_least: 2\n"),
            6,
            "less than or equal to 1",
        ),
        ("description: d\nfaults: []\n", 2, "at least 1 item"),
        ("faults:\n  - crash_mode: mute\n", None, "'description' is missing"),
    ],
)
def test_a_wrong_file_is_refused_with_its_line(
    tmp_path: Path, text: str, line: int | None, names: str
) -> None:
    with pytest.raises(UserError, match=names) as caught:
        scenario(tmp_path, text)
    assert "\n" not in str(caught.value)
    place = f"faults.yaml:{line}: " if line is not None else "faults.yaml: "
    assert place in str(caught.value)


@pytest.mark.parametrize(
    ("entry", "line", "names"),
    [
        ("start_step: 1\n    victims: [robot_9]", 4, "unknown robot 'robot_9'.*robot_1, robot_2"),
        ("victim_role: nurse", 3, "unknown victim_role 'nurse'; one of: scout, lifter"),
        ("victims: [robot_1]\n    start_step: 20", 4, "at most 20 steps, the last is 19"),
        ("crashed_exactly: 5", 3, "crashed_exactly asks for 5 crashed robots; the team has 4"),
        ("victim_role: scout\n    crashed_exactly: 3", 4, "the team has 2 robots of role 'scout'"),
        ("crashed_exactly: 3\n    min_alive: 2", 3, "min_alive 2 and max_crashed -1 allow 2 of 4"),
        ("min_alive: 5", 3, "min_alive 5 is more than the team's 4 robots"),
    ],
)
def test_what_this_team_cannot_reach_is_refused_with_its_line(
    tmp_path: Path, entry: str, line: int, names: str
) -> None:
    read = scenario(tmp_path, file_of(entry))
    with pytest.raises(UserError, match=names) as caught:
        read.check(TEAM, LIMIT)
    assert f"faults.yaml:{line}: faults.0: " in str(caught.value)


def test_a_hazard_needs_the_length_of_a_step(tmp_path: Path) -> None:
    read = scenario(tmp_path, file_of("hazard_rate_hz: 0.1"))
    read.check(TEAM, LIMIT)
    with pytest.raises(UserError, match=r"faults.yaml:3: .*dt_s is unknown"):
        read.check(TeamSpec(TEAM.robots))


def test_the_last_step_of_an_episode_is_reached(tmp_path: Path) -> None:
    scenario(tmp_path, file_of("start_step: 19")).check(TEAM, LIMIT)


def test_entries_may_not_break_each_others_limits(tmp_path: Path) -> None:
    one = "{victims: [robot_1, robot_2]}"
    read = scenario(tmp_path, file_of(one, "{victims: [robot_3], min_alive: 2, start_step: 4}"))
    with pytest.raises(
        UserError, match=r"yaml:4: .*up to 3 robots .* from step 4 on.*allow 2 of 4"
    ):
        read.check(TEAM, LIMIT)
    after = "{victims: [robot_1, robot_2], duration_steps: 4}"
    scenario(tmp_path, file_of(after, "{victims: [robot_3], min_alive: 2, start_step: 4}")).check(
        TEAM, LIMIT
    )
    same = "{victims: [robot_1], crash_mode: random, min_alive: 2}"
    scenario(tmp_path, file_of(one, same)).check(TEAM, LIMIT)


def test_a_plan_has_every_entry(tmp_path: Path) -> None:
    read = scenario(
        tmp_path,
        file_of(
            "{crash_mode: delay, crash_parameters: {steps: 2}, victims: [robot_3]}",
            "{crash_mode: stay, victim_role: scout, crashed_exactly: 1, start_step: 3}",
            "{crash_mode: drop, hazard_rate_hz: 0.2, min_alive: 1}",
        ),
    )
    plan = ScenarioPlanner(read, TEAM, seed=7).plan(5)
    assert (plan.episode, plan.seed, plan.cap) == (5, 7, 3)
    first, second, *rest = plan.faults
    assert (first.robot, first.mode, first.parameters, first.entry) == (
        2,
        "delay",
        (("steps", 2),),
        0,
    )
    assert (second.robot in (0, 1), second.mode, second.start_step) == (True, "mute", 3)
    assert [fault.robot for fault in rest] == [0, 1, 2, 3]
    assert {(f.mode, f.trigger.kind, f.entry) for f in rest} == {("drop", TriggerKind.HAZARD, 2)}


def drawn(plan: CrashPlan, entry: int) -> list[int]:
    return [fault.robot for fault in plan.faults if fault.entry == entry]


@given(seed=st.integers(0, 2**63 - 1), episode=st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_plans_follow_from_seed_episode_and_entry(
    tmp_path_factory: pytest.TempPathFactory, seed: int, episode: int
) -> None:
    folder = tmp_path_factory.mktemp("plans")
    two, three = "{crashed_exactly: 2}", "{crashed_exactly: 3, start_step: 9}"
    one = ScenarioPlanner(scenario(folder, file_of(two)), TEAM, seed)
    both = ScenarioPlanner(scenario(folder, file_of(two, three)), TEAM, seed)
    both.plan(episode + 1)
    plan = both.plan(episode)
    assert plan == both.plan(episode)
    assert len(drawn(plan, 0)) == 2
    assert len(drawn(plan, 1)) == 3
    assert drawn(plan, 0) == drawn(one.plan(episode), 0), "another entry changes nothing"


def test_entries_draw_apart(tmp_path: Path) -> None:
    read = scenario(tmp_path, file_of("{crashed_exactly: 1}", "{crashed_exactly: 1}"))
    plans = [ScenarioPlanner(read, TEAM, 1).plan(episode) for episode in range(4000)]
    same = sum(drawn(plan, 0) == drawn(plan, 1) for plan in plans)
    assert 850 < same < 1150  # a quarter; five standard deviations are 137
    for entry in (0, 1):
        for robot in range(4):
            assert 850 < sum(drawn(plan, entry) == [robot] for plan in plans) < 1150


limits = st.fixed_dictionaries(
    {},
    optional={
        "min_alive": st.integers(0, 4),
        "max_crashed": st.integers(-1, 4),
        "start_step": st.integers(0, 12),
        "duration_steps": st.integers(0, 8),
        "crashed_exactly": st.integers(0, 4),
        "hazard_rate_hz": st.sampled_from([0.0, 0.3, 3.0]),
    },
)


@given(entries=st.lists(limits, min_size=1, max_size=4), seed=st.integers(0, 1000))
@settings(max_examples=200)
def test_limits_hold_in_every_step_of_every_file_that_is_accepted(
    entries: list[dict[str, float]], seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    # JSON is YAML.
    read = scenario(
        tmp_path_factory.mktemp("limits"), file_of(*(json.dumps(entry) for entry in entries))
    )
    try:
        read.check(TEAM, LIMIT)
    except UserError:
        return
    plan = ScenarioPlanner(read, TEAM, seed).plan(0)
    limit = min(
        min(4 - entry.get("min_alive", 0), 4 if (m := entry.get("max_crashed", -1)) < 0 else m)
        for entry in entries
    )
    followed = Schedule(plan)
    for step in range(LIMIT):
        followed.enter(step, None)
        faulted = {plan.faults[place].robot for place in followed.in_force}
        assert len(faulted) <= limit, f"step {step}: {faulted}"


def test_a_negative_seed_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="seed -1"):
        ScenarioPlanner(scenario(tmp_path, file_of("start_step: 1")), TEAM, -1)


def test_shipped_files_are_found_by_name(tmp_path: Path) -> None:
    assert {"one_mute", "hazard", "adversary"} <= set(fault_scenario_names())
    for name in fault_scenario_names():
        read = load_fault_scenario(find_fault_scenario(name))
        assert read.expect, name
    with pytest.raises(UserError, match=r"'one_mut' \(did you mean 'one_mute'\?\)"):
        find_fault_scenario("one_mut")
    with pytest.raises(UserError, match="no fault scenario file"):
        find_fault_scenario(str(tmp_path / "none.yaml"))
    with pytest.raises(UserError, match="cannot be read"):
        load_fault_scenario(tmp_path / "none.yaml")
