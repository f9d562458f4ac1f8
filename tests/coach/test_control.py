"""The coach node's core: following episodes, evaluation blocks, revisions; and its parameters."""

from __future__ import annotations

from typing import Any

import pytest

from crash_coach_pkg.config import CoachConfig, check_robots
from crash_coach_pkg.control import Control, ControlSettings
from crash_coach_pkg.parameters import build_settings, check_change, parameter_specs
from crash_coach_pkg.plan import NEXT_STEP, Mode
from sim_pkg.contract import UserError

ROBOTS = ("robot_1", "robot_2", "robot_3")
DEFAULTS = {spec.name: spec.default for spec in parameter_specs()}


def control(revision: int = 0, **coach: Any) -> Control:
    own = {key: coach.pop(key) for key in list(coach) if key in ControlSettings.model_fields}
    config = CoachConfig(**{"strategy": "fixed", **coach})
    return Control(ControlSettings(**own, coach=config), ROBOTS, revision)


def settings(**values: Any) -> ControlSettings:
    return build_settings({**DEFAULTS, **values}, ROBOTS)


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
        (0, Mode.RANDOM, NEXT_STEP, 2)
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
    coach = control(strategy="adaptive", beta=0.5, rho=0.5, block_episodes=4)
    rates = []
    for episode, success in enumerate([1, 1, 0, 0, 0, 0, 0, 1, 1]):
        coach.follow(episode)
        record = coach.finish(bool(success))
        coach.finish(not success)  # the end is seen once
        rates.append(coach.rate)
        assert (record is not None) == (episode in (3, 7))
    assert rates == [0, 0, 0, 0.5, 0.5, 0.5, 0.5, 0.25, 0.25]


def test_curriculum_follows_finished_episodes() -> None:
    coach = Control(
        settings(strategy="curriculum", alpha_max=0.4, curriculum_episodes=4), ROBOTS, 0
    )
    rates = []
    for episode in range(6):
        coach.follow(episode)
        coach.finish(False)
        rates.append(coach.rate)
    assert rates == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.4, 0.4])


def test_the_rate_goes_on_through_a_change_of_settings() -> None:
    coach = control(strategy="adaptive", rho=0.5, block_episodes=1)
    coach.follow(0)
    coach.finish(True)
    coach.configure(settings(strategy="adaptive", rho=0.1), now=False)
    assert coach.rate == 0.5
    coach.configure(settings(strategy="adaptive", alpha_max=0.2), now=False)
    assert coach.rate == 0.2
    coach.configure(settings(strategy="fixed", crash_rate=0.9), now=False)
    assert coach.rate == 0.9
    coach.configure(settings(strategy="fixed", crash_rate=0.8), now=False)
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
    assert (over.revision, over.faults) == (51, plan.faults)


def test_every_setting_is_a_parameter_with_a_description() -> None:
    names = [spec.name for spec in parameter_specs()]
    assert len(set(names)) == len(names)
    assert set(names) == {
        "enabled", "strategy", "crash_rate", "crash_mode", "victims", "start_step",
        "duration_steps", "max_crashed", "min_alive", "beta", "rho", "alpha_max", "seed",
        "apply_at", "lease_s", "resample", "cap_rule", "crashed_exactly", "block_episodes",
        "curriculum_episodes",
    }  # fmt: skip
    for spec in parameter_specs():
        assert spec.description
        numeric = isinstance(spec.default, int | float) and not isinstance(spec.default, bool)
        assert numeric == (spec.low is not None and spec.high is not None), spec.name
        if spec.low is not None and spec.high is not None:
            assert isinstance(spec.default, int | float)
            assert spec.low <= spec.default <= spec.high


def test_defaults_crash_nobody() -> None:
    coach = Control(settings(), ROBOTS, 0)
    plans = [coach.follow(episode) for episode in range(50)]
    assert all(plan is not None and not plan.faults for plan in plans)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"victims": ("robot_4",)}, "unknown robot 'robot_4' in victims; one of: robot_1"),
        ({"victims": ("none", "robot_1")}, "'none' stands alone"),
        ({"victims": ("robot_1", "robot_1")}, "more than once"),
        ({"victims": ()}, None),
        ({"crash_rate": float("nan")}, "crash_rate nan: .*finite"),
        ({"crash_rate": 1.5}, "crash_rate 1.5: .*less than or equal to 1"),
        ({"rho": 0.0}, "rho 0.0: .*greater than 0"),
        ({"alpha_max": -0.5}, "alpha_max -0.5: 0 to 1, or -1"),
        ({"alpha_max": 0.0, "strategy": "curriculum"}, None),
        ({"crash_mode": "explode"}, "crash_mode 'explode': .*'mute'"),
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
        ({"victims": ("robot_1",), "enabled": False}, "victims would have no effect: enabled"),
        ({"victims": ("robot_1",), "strategy": "none"}, "strategy is none"),
        ({"crashed_exactly": 1, "enabled": False}, "crashed_exactly would have no effect"),
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
    ("names", "message"),
    [([], "empty"), (["a b"], "'a b' is not a valid"), (["a", "a"], "'a' more than once")],
)
def test_bad_teams(names: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        check_robots(names)
