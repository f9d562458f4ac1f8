"""The coach node's core: following episodes, evaluation blocks, revisions, taking over."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crash_coach_common.contract import UserError
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.coach.live_coach import AHEAD, Control, ControlSettings
from crash_coach_pkg.coach.parameters import build_settings, parameter_specs
from crash_coach_pkg.plan import NEXT_STEP, CrashPlan, Fault
from crash_coach_pkg.team import TeamSpec, check_robots

TEAM = TeamSpec(("robot_1", "robot_2", "robot_3"), ("scout", "scout", "hauler"), 0.1)
DEFAULTS = {spec.name: spec.default for spec in parameter_specs()}


def control(revision: int = 0, **coach: Any) -> Control:
    own = {key: coach.pop(key) for key in list(coach) if key in ControlSettings.model_fields}
    config = CoachConfig(**{"strategy": "fixed", **coach})
    return Control(ControlSettings(**own, coach=config), TEAM, revision)


def settings(**values: Any) -> ControlSettings:
    return build_settings({**DEFAULTS, **values}, TEAM)


def test_each_new_episode_has_one_plan_of_a_growing_revision() -> None:
    coach = control(revision=100, victims=("robot_2",))
    first = coach.follow(0)
    assert first is not None
    assert coach.follow(0) is None
    second = coach.follow(1)
    assert second is not None
    assert [(p.episode, p.revision) for p in (first, second)] == [(0, 101), (1, 102)]
    assert [fault.robot for fault in second.faults] == [1]
    assert coach.published(101)
    assert not coach.published(100)
    assert not coach.published(103)


def test_a_change_now_starts_at_the_next_step_and_stays_for_later_episodes() -> None:
    coach = control()
    coach.follow(0)
    wanted = settings(victims=("robot_1",), crash_mode="random", start_step=3, duration_steps=2)
    plan = coach.configure(wanted, now=True)
    assert plan is not None
    assert plan.revision == 2
    assert [(f.robot, f.mode, f.start_step, f.duration_steps) for f in plan.faults] == [
        (0, "random", NEXT_STEP, 2)
    ]
    later = coach.follow(1)
    assert later is not None
    assert later.faults[0].start_step == 3


def test_a_change_for_the_next_episode_leaves_the_plan_alone() -> None:
    coach = control()
    plan = coach.follow(0)
    assert coach.configure(settings(victims=("robot_1",)), now=False) is None
    assert coach.plan == plan
    later = coach.follow(1)
    assert later is not None
    assert len(later.faults) == 1


def test_before_the_first_episode_there_is_nothing_to_revise() -> None:
    coach = control()
    assert coach.configure(settings(victims=("robot_1",)), now=True) is None
    plan = coach.follow(7)
    assert plan is not None
    assert len(plan.faults) == 1


def test_disabled_nobody_crashes_and_blocks_rest() -> None:
    coach = control(victims=("robot_1",), block_episodes=1)
    coach.follow(0)
    plan = coach.configure(settings(enabled=False, victims=("robot_1",)), now=True)
    assert plan is not None
    assert (plan.faults, plan.cap) == ((), 0)
    assert coach.finish(True) is None


def test_a_refused_change_is_undone_under_a_new_revision() -> None:
    coach = control(victims=("robot_1",), duration_steps=4)
    old = coach.follow(0)
    assert old is not None
    before = coach.snapshot()
    coach.configure(settings(victims=("robot_2",)), now=True)
    restored = coach.restore(before)
    assert restored is not None
    assert (restored.faults, restored.revision) == (old.faults, 3)
    assert coach.settings == before.settings


def test_undoing_after_the_episode_changed_plans_the_new_one() -> None:
    coach = control(victims=("robot_1",))
    coach.follow(0)
    before = coach.snapshot()
    coach.configure(settings(victims=("robot_2",)), now=True)
    coach.follow(1)
    restored = coach.restore(before)
    assert restored is not None
    assert (restored.episode, restored.faults[0].robot) == (1, 0)


def test_adaptive_moves_by_complete_blocks_only() -> None:
    coach = control(strategy="adaptive", adaptive={"beta": 0.5, "rho": 0.5}, block_episodes=4)
    rates = []
    for episode, success in enumerate([1, 1, 0, 0, 0, 0, 0, 1, 1]):
        coach.follow(episode)
        record = coach.finish(bool(success))
        coach.finish(not success)  # the end is seen once
        rates.append(coach.rate)
        assert (record is not None) == (episode in (3, 7))
    assert rates == [0, 0, 0, 0.5, 0.5, 0.5, 0.5, 0.25, 0.25]


def test_curriculum_follows_finished_episodes() -> None:
    wanted = settings(
        strategy="curriculum", **{"curriculum.alpha_max": 0.4, "curriculum.episodes": 4}
    )
    coach = Control(wanted, TEAM, 0)
    rates = []
    for episode in range(6):
        coach.follow(episode)
        coach.finish(False)
        rates.append(coach.rate)
    assert rates == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.4, 0.4])


def test_the_rate_goes_on_through_a_change_of_settings() -> None:
    coach = control(strategy="adaptive", adaptive={"rho": 0.5}, block_episodes=1)
    coach.follow(0)
    coach.finish(True)
    coach.configure(settings(strategy="adaptive", **{"adaptive.rho": 0.1}), now=False)
    assert coach.rate == 0.5
    coach.configure(settings(strategy="adaptive", **{"adaptive.alpha_max": 0.2}), now=False)
    assert coach.rate == 0.2
    coach.configure(settings(strategy="fixed", crash_rate=0.9), now=False)
    assert coach.rate == 0.9
    coach.configure(settings(strategy="fixed", crash_rate=0.8), now=False)
    assert coach.rate == 0.8
    # Found by the parameter fuzz: the same settings once gave another rate than from the start.
    coach.configure(
        settings(strategy="fixed", crash_rate=0.8, **{"adaptive.alpha_max": 0.1}), now=False
    )
    assert coach.rate == 0.8
    coach.configure(settings(strategy="adaptive"), now=False)
    assert coach.rate == 0.0


def test_a_plan_of_another_coach_is_overtaken() -> None:
    coach = control(revision=10)
    assert coach.overtake(50) is None
    plan = coach.follow(0)
    assert plan is not None
    assert coach.overtake(plan.revision) is None
    over = coach.overtake(50)
    assert over is not None
    assert (over.revision, over.faults) == (50 + AHEAD + 1, plan.faults)


@given(st.integers(1, 20), st.lists(st.integers(0, 1), max_size=30), st.booleans())
def test_two_coaches_never_number_alike(before: int, changes: list[int], told: bool) -> None:
    """The second takes over, from the gate's plan or from an event, while the first goes on."""
    first, second = control(revision=100), control(revision=100 - before)
    in_force = first.follow(0)
    assert in_force is not None
    for _ in range(before):
        in_force = first.configure(settings(), now=True) or in_force
    if told:
        taken = second.adopt(in_force)
    else:
        second.follow(0)
        taken = second.overtake(in_force.revision)
    assert taken is not None
    ours, theirs = {taken.revision}, {in_force.revision}
    for who in changes:
        plan = (first, second)[who].configure(settings(), now=True)
        assert plan is not None
        (theirs, ours)[who].add(plan.revision)
    assert min(ours) > max(theirs)  # the newer coach's plans are those in force
    assert all(second.published(revision) for revision in ours)
    assert not any(second.published(revision) for revision in theirs)
    assert not any(first.published(revision) for revision in ours)


def test_a_fault_that_runs_does_not_begin_anew_with_a_later_revision() -> None:
    coach = control()
    coach.follow(0)
    plan = coach.configure(settings(victims=("robot_1",), duration_steps=3), now=True)
    assert plan is not None
    coach.armed(plan.revision - 1, 5)
    assert coach.plan == plan
    coach.armed(plan.revision, 7)
    before = coach.snapshot()
    coach.configure(settings(victims=("robot_2",)), now=True)
    restored = coach.restore(before)
    assert restored is not None
    assert [(f.robot, f.start_step, f.duration_steps) for f in restored.faults] == [(0, 7, 3)]


def left(episode: int = 4, revision: int = 900, rate: float = 0.25) -> CrashPlan:
    """What a coach before left in force."""
    fault = Fault(1, "drop", 12, 30, (("probability", 0.5),))
    return CrashPlan(episode, revision, 7, rate, 2, (fault,))


def test_a_new_coach_takes_over_plan_and_rate_and_plans_the_next_episode_itself() -> None:
    coach = control(revision=10, strategy="adaptive", adaptive={"rho": 0.5}, block_episodes=1)
    plan = coach.adopt(left())
    assert plan is not None
    assert plan == replace(left(), revision=900 + AHEAD + 1)
    assert (coach.rate, coach.plan) == (0.25, plan)
    assert coach.follow(4) is None
    assert not coach.published(900)
    assert coach.published(900 + AHEAD + 1)
    coach.finish(True)  # the episode counts, however it began
    following = coach.follow(5)
    assert following is not None
    assert (following.revision, following.rate) == (900 + AHEAD + 2, 0.625)
    assert coach.adopt(left(revision=2000)) is None


def test_what_is_not_in_force_is_not_taken_over() -> None:
    coach = control(revision=10, victims=("robot_3",))
    assert coach.adopt(left(revision=0)) is None
    plan = coach.follow(4)
    assert plan is not None
    assert ([fault.robot for fault in plan.faults], plan.revision) == ([2], 11)


def test_the_episode_may_have_changed_since() -> None:
    coach = control(revision=10, victims=("robot_3",))
    coach.adopt(left(episode=4))
    plan = coach.follow(6)
    assert plan is not None
    assert ([fault.robot for fault in plan.faults], plan.revision) == ([2], 900 + AHEAD + 2)


def test_a_curriculum_goes_on_from_the_episodes_number() -> None:
    wanted = settings(
        strategy="curriculum", **{"curriculum.alpha_max": 0.4, "curriculum.episodes": 8}
    )
    coach = Control(wanted, TEAM, 0)
    coach.adopt(left(episode=4, rate=0.2))
    assert coach.rate == pytest.approx(0.2)
    coach.finish(True)
    assert coach.rate == pytest.approx(0.25)


class Every:
    """A planner: robot_2 is muted in steps 3 and 4 of every episode."""

    def plan(self, episode: int) -> CrashPlan:
        return CrashPlan(episode, 0, 5, 0.0, 1, (Fault(1, "mute", 3, 2),))


def test_a_scenarios_planner_decides_instead_of_the_coach() -> None:
    coach = Control(settings(victims=("robot_1",), block_episodes=1), TEAM, 20, Every())
    plans = [coach.follow(episode) for episode in (0, 1)]
    assert plans == [replace(Every().plan(e), revision=21 + e) for e in (0, 1)]
    assert coach.finish(True) is None
    off = coach.configure(settings(enabled=False), now=True)
    assert off is not None
    assert not off.faults
    on = coach.configure(settings(), now=True)
    assert on is not None
    assert on.faults == Every().plan(1).faults  # its steps, not "the next one"


def test_defaults_crash_nobody() -> None:
    coach = Control(settings(), TEAM, 0)
    plans = [coach.follow(episode) for episode in range(50)]
    assert all(plan is not None and not plan.faults for plan in plans)


@pytest.mark.parametrize(
    ("names", "message"),
    [([], "empty"), (["a b"], "'a b' is not a valid"), (["a", "a"], "'a' more than once")],
)
def test_bad_teams(names: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        check_robots(names)


def test_a_trainers_blocks_take_the_place_of_the_coachs_own() -> None:
    adaptive = {"strategy": "adaptive", "adaptive": {"beta": 0.5, "rho": 0.5, "alpha_max": 0.8}}
    coach = control(success_from="trainer", block_episodes=1, **adaptive)
    coach.follow(0)
    assert coach.finish(True) is None
    record = coach.evaluated(0.75)
    assert record is not None
    assert (record.success_rate, record.decision, record.episodes) == (0.75, "raise", 1)
    assert coach.rate == record.new_rate == 0.5
    later = coach.follow(1)
    assert later is not None
    assert later.rate == 0.5
    with pytest.raises(UserError, match=r"success rate 1.5 of a trainer's block"):
        coach.evaluated(1.5)
    coach.configure(settings(enabled=False, success_from="trainer", strategy="adaptive"), now=True)
    assert coach.evaluated(0.75) is None
    own = control(**adaptive)
    own.follow(0)
    assert own.evaluated(0.75) is None
    assert own.rate == 0.0
