"""Caps, the law of the truncated draw, and who is drawn."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.config import CapRule, CoachConfig
from crash_coach_pkg.coach.draws import most_crashed
from crash_coach_pkg.coach.strategies import strategy_names
from crash_coach_pkg.coach.victims import crash_cap, draw_exactly, draw_mask, episode_rng
from crash_coach_pkg.plan import AT_START_STEP
from crash_coach_pkg.team import TeamSpec

TEAM = TeamSpec(tuple(f"robot_{i + 1}" for i in range(8)))


@pytest.mark.parametrize(
    ("rule", "n", "rate", "cap"),
    [
        # ALGORITHM: floor with alpha 0.1 never crashes anybody in a team of 3 ...
        ("floor", 3, 0.1, 0),
        ("floor", 3, 0.34, 1),
        ("floor", 8, 0.1, 0),
        ("floor", 8, 0.25, 2),
        ("floor", 3, 1.0, 3),
        # ... and authors not until alpha > 1/6.
        ("authors", 3, 0.1, 0),
        ("authors", 3, 0.16, 0),
        ("authors", 3, 0.17, 1),
        ("authors", 2, 0.25, 0),  # round(1.5) = 2: half to even
        ("authors", 2, 0.75, 2),  # round(0.5) = 0: half to even
        ("authors", 8, 0.1, 1),
        ("ceil", 3, 0.0, 0),
        ("ceil", 3, 0.1, 1),
        ("ceil", 3, 1 / 3, 1),
        ("ceil", 10, 0.3, 3),  # 10 * 0.3 is not exactly 3
        ("ceil", 3, 0.34, 2),
        ("ceil", 3, 1.0, 3),
    ],
)
def test_cap_rules(rule: CapRule, n: int, rate: float, cap: int) -> None:
    assert crash_cap(rule, n, rate, n, True) == cap


@pytest.mark.parametrize(
    ("max_crashed", "min_alive", "resample", "cap"),
    [(-1, 0, False, 8), (3, 0, False, 3), (-1, 6, False, 2), (0, 0, True, 0), (3, 7, True, 1)],
)
def test_limits_hold_with_and_without_resampling(
    max_crashed: int, min_alive: int, resample: bool, cap: int
) -> None:
    config = CoachConfig(
        strategy="fixed", crash_rate=0.5, max_crashed=max_crashed, min_alive=min_alive,
        resample=resample,
    )  # fmt: skip
    assert Coach(config, TEAM, seed=0).cap == cap
    assert crash_cap("ceil", 8, 0.5, most_crashed(config, 8), resample) == cap


def _rejection_counts(n: int, rate: float, cap: int, draws: int) -> np.ndarray:
    """Counts of each mask (as a bit pattern) by the paper's rejection."""
    rng = np.random.default_rng(7)
    counts = np.zeros(2**n)
    left = draws
    while left:
        mask = rng.random(n) < rate
        if mask.sum() <= cap:
            counts[int(mask @ (1 << np.arange(n)))] += 1
            left -= 1
    return counts


@pytest.mark.parametrize(("n", "rate", "cap"), [(3, 0.3, 1), (4, 0.5, 2), (3, 0.05, 3)])
def test_truncated_draw_has_the_law_of_rejection(
    n: int, rate: float, cap: int, fits: Callable[..., bool]
) -> None:
    draws = 20_000
    rng = np.random.default_rng(11)
    ours = np.zeros(2**n)
    for _ in range(draws):
        ours[int(draw_mask(rng, n, rate, cap) @ (1 << np.arange(n)))] += 1
    theirs = _rejection_counts(n, rate, cap, draws)
    sizes = np.array([bin(m).count("1") for m in range(2**n)])
    exact = rate**sizes * (1 - rate) ** (n - sizes) * (sizes <= cap)
    expected = draws * exact / exact.sum()
    assert ours[exact == 0].sum() == theirs[exact == 0].sum() == 0
    possible = exact > 0
    assert fits(ours[possible], expected[possible])
    assert fits(theirs[possible], expected[possible])


def test_plain_bernoulli_without_resampling(fits: Callable[..., bool]) -> None:
    config = CoachConfig(strategy="fixed", crash_rate=0.4, resample=False)
    coach = Coach(config, TEAM, seed=2)
    counts = np.bincount([len(coach.plan(e).faults) for e in range(5000)], minlength=9)
    expected = 5000 * np.array([math.comb(8, k) * 0.4**k * 0.6 ** (8 - k) for k in range(9)])
    head = slice(0, 7)  # the last classes are too rare for a chi-square; pool them
    observed = np.append(counts[head], counts[7:].sum())
    assert fits(observed, np.append(expected[head], expected[7:].sum()))


@pytest.mark.parametrize("rate", [0.0, 1.0])
@pytest.mark.parametrize("cap", [0, 2, 8])
def test_extreme_rates(rate: float, cap: int) -> None:
    mask = draw_mask(np.random.default_rng(0), 8, rate, cap)
    assert mask.sum() == (cap if rate == 1.0 else 0)


def test_exactly_k_is_uniform(fits: Callable[..., bool]) -> None:
    rng = np.random.default_rng(3)
    pairs = [tuple(np.flatnonzero(draw_exactly(rng, 4, 2))) for _ in range(6000)]
    assert len(set(pairs)) == 6
    assert fits([pairs.count(pair) for pair in set(pairs)], 1000)


def test_mask_depends_on_its_arguments_alone() -> None:
    config = CoachConfig(strategy="fixed", crash_rate=0.5)
    first = Coach(config, TEAM, seed=4)
    forward = [first.plan(episode) for episode in range(40)]
    second = Coach(config, TEAM, seed=4)
    backward = [second.plan(episode) for episode in reversed(range(40))]
    assert forward == backward[::-1]
    masks = {tuple(f.robot for f in plan.faults) for plan in forward}
    assert len(masks) > 10
    other = Coach(config, TEAM, seed=5)
    assert forward != [other.plan(episode) for episode in range(40)]


def test_episode_rng_is_not_the_environments_stream() -> None:
    env = np.random.Generator(np.random.Philox(key=[4, 9]))
    assert episode_rng(4, 9).random() != env.random()
    assert episode_rng(4, 9).random() == episode_rng(4, 9).random()


def test_victims_mode_window_and_cap_reach_the_plan() -> None:
    config = CoachConfig(
        strategy="fixed", victims=("robot_3", "robot_1"), crash_mode="random",
        start_step=4, duration_steps=2,
    )  # fmt: skip
    plan = Coach(config, TEAM, seed=6).plan(17)
    assert (plan.episode, plan.seed, plan.cap) == (17, 6, 2)
    assert [(f.robot, f.mode, f.start_step, f.duration_steps) for f in plan.faults] == [
        (0, "random", 4, 2),
        (2, "random", 4, 2),
    ]
    assert {(f.parameters, f.trigger, f.entry) for f in plan.faults} == {((), AT_START_STEP, 0)}


@pytest.mark.parametrize("strategy", strategy_names())
def test_named_victims_crash_under_every_strategy(strategy: str) -> None:
    config = CoachConfig(strategy=strategy, victims=("robot_3",))
    plan = Coach(config, TEAM, seed=6).plan(17)
    assert ([f.robot for f in plan.faults], plan.cap) == ([2], 1)


def test_crashed_exactly_varies_the_victims_and_keeps_the_number() -> None:
    coach = Coach(CoachConfig(strategy="fixed", crashed_exactly=2), TEAM, seed=1)
    plans = [coach.plan(episode) for episode in range(60)]
    assert {len(plan.faults) for plan in plans} == {2}
    assert len({tuple(f.robot for f in plan.faults) for plan in plans}) > 10


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"victims": ("robot_9",)}, "unknown robot 'robot_9'.*robot_1, robot_2"),
        ({"min_alive": 9}, "min_alive 9 is more than the team's 8 robots"),
        ({"max_crashed": 9}, "max_crashed 9"),
        ({"victims": ("robot_1", "robot_2"), "max_crashed": 1}, "victims asks for 2.*allow 1"),
        ({"crashed_exactly": 3, "min_alive": 6}, "crashed_exactly asks for 3.*allow 2"),
    ],
)
def test_settings_that_a_team_cannot_keep(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Coach(CoachConfig(**settings), TEAM, seed=0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"strategy": "adaptiv"}, "unknown coaching strategy 'adaptiv'.*adaptive"),
        ({"crash_rate": float("nan")}, "crash_rate"),
        ({"crash_rate": 1.01}, "crash_rate"),
        ({"adaptive": {"rho": 0.0}}, "strategy adaptive: setting rho = 0.0: .*greater than 0"),
        (
            {"adaptive": {"roh": 0.5}},
            "adaptive: unknown setting 'roh'.*did you mean 'rho'.*beta, rho",
        ),
        ({"adaptive": 0.5}, "adaptive = 0.5: settings are needed"),
        ({"beta": 0.5}, "unknown key 'beta' of the coach .did you mean 'adaptive.beta'"),
        ({"alpha_max": 1}, "did you mean 'curriculum.alpha_max' or 'adaptive.alpha_max'"),
        ({"curriculum_fraction": 1}, "did you mean 'curriculum.fraction'"),
        ({"crash_mode": "explode"}, "crash_mode"),
        ({"cap_rule": "round"}, "cap_rule"),
        ({"victims": ("robot_1", "robot_1")}, "robot_1 more than once"),
        ({"victims": ("robot_1",), "crashed_exactly": 1}, "contradict"),
        ({"crash_rte": 0.1}, "crash_rte"),
    ],
)
def test_bad_settings_name_the_key(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        CoachConfig(**settings)


def test_every_setting_has_a_description() -> None:
    assert all(field.description for field in CoachConfig.model_fields.values())


def test_negative_seed_is_refused() -> None:
    with pytest.raises(ValueError, match="seed -1"):
        Coach(CoachConfig(), TEAM, seed=-1)
