"""The crash rate's path against the formulas of the paper, worked out by hand."""

from __future__ import annotations

import json
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from typing import Any

import pytest

from crash_coach_pkg.coach import strategies
from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.config import CoachConfig, TeamSpec
from crash_coach_pkg.coach.strategies import Progress, make_strategy

TEAM = TeamSpec(("robot_1", "robot_2", "robot_3"))
NOWHERE = Progress(env_steps=0, total_steps=0, episodes=0)


def test_adaptive_path_equals_the_formula() -> None:
    coach = Coach(CoachConfig(strategy="adaptive", beta=0.75, rho=0.1), TEAM, seed=0)
    assert coach.rate == 0.0
    path = []
    for success in (0.75, 1.0, 0.74, 0.9, 0.0):
        record = coach.record_block(success, NOWHERE)
        assert record.new_rate == coach.rate
        path.append((record.rate, record.decision, record.new_rate))
    # 0 -> .1 -> .1+.1*.9=.19 -> .19*.9=.171 -> .171+.1*.829=.2539 -> .2539*.9=.22851
    expected = [
        (0.0, "raise", 0.1),
        (0.1, "raise", 0.19),
        (0.19, "lower", 0.171),
        (0.171, "raise", 0.2539),
        (0.2539, "lower", 0.22851),
    ]
    for (rate, decision, new), (rate_0, decision_0, new_0) in zip(path, expected, strict=True):
        assert decision == decision_0
        assert (rate, new) == pytest.approx((rate_0, new_0), abs=1e-12)


def test_adaptive_without_ceiling_tends_to_one_and_alpha_max_stops_it() -> None:
    free = Coach(CoachConfig(strategy="adaptive", rho=0.1), TEAM, seed=0)
    capped = Coach(CoachConfig(strategy="adaptive", rho=0.1, alpha_max=0.3), TEAM, seed=0)
    for _ in range(200):
        free.record_block(1.0, NOWHERE)
        capped.record_block(1.0, NOWHERE)
    assert free.rate > 0.999
    assert capped.rate == 0.3
    assert capped.record_block(1.0, NOWHERE).decision == "keep"


def test_adaptive_moves_only_at_blocks() -> None:
    coach = Coach(CoachConfig(strategy="adaptive"), TEAM, seed=0)
    coach.advance(Progress(env_steps=10**6, total_steps=10**6, episodes=10**5))
    assert coach.rate == 0.0


@pytest.mark.parametrize(("steps", "rate"), [(0, 0.0), (250, 0.05), (500, 0.1), (1000, 0.1)])
def test_curriculum_in_environment_steps(steps: int, rate: float) -> None:
    coach = Coach(CoachConfig(strategy="curriculum"), TEAM, seed=0)
    coach.advance(Progress(env_steps=steps, total_steps=1000, episodes=7))
    assert coach.rate == pytest.approx(rate)


@pytest.mark.parametrize(("episodes", "rate"), [(0, 0.0), (10, 0.02), (200, 0.4), (1000, 0.4)])
def test_curriculum_per_episode(episodes: int, rate: float) -> None:
    config = CoachConfig(strategy="curriculum", curriculum_delta=0.002, alpha_max=0.4)
    coach = Coach(config, TEAM, seed=0)
    coach.advance(Progress(env_steps=0, total_steps=0, episodes=episodes))
    assert coach.rate == pytest.approx(rate)


def test_curriculum_needs_a_length_of_training() -> None:
    coach = Coach(CoachConfig(strategy="curriculum"), TEAM, seed=0)
    with pytest.raises(ValueError, match=r"total_steps = 0.*curriculum_delta"):
        coach.advance(NOWHERE)


def test_curriculum_alone_crashes_robots() -> None:
    coach = Coach(CoachConfig(strategy="curriculum"), TEAM, seed=3)
    crashed = [0, 0]
    for episode in range(2000):
        coach.advance(Progress(env_steps=episode, total_steps=2000, episodes=episode))
        crashed[episode >= 1000] += len(coach.plan(episode).faults)
    assert 0 < crashed[0] < crashed[1]
    # At alpha 0.1 and cap 1: P(1) = .243/(.729+.243) = .25.
    assert crashed[1] / 1000 == pytest.approx(0.25, abs=0.05)


def test_fixed_and_none() -> None:
    fixed = Coach(CoachConfig(strategy="fixed", crash_rate=0.4), TEAM, seed=0)
    assert fixed.record_block(0.0, NOWHERE).new_rate == 0.4
    none = Coach(CoachConfig(strategy="none", victims=("robot_1",)), TEAM, seed=0)
    assert all(not none.plan(episode).faults for episode in range(100))


def test_strategies_are_pure() -> None:
    for name in ("none", "fixed", "curriculum", "adaptive"):
        strategy = make_strategy(CoachConfig(strategy=name, crash_rate=0.2))
        where = Progress(env_steps=5, total_steps=50, episodes=2)
        first = [strategy.next_rate(0.1, e, where) for e in (None, 0.2, 0.9)]
        again = [strategy.next_rate(0.1, e, where) for e in (0.9, 0.2, None)]
        assert first == again[::-1]


def test_only_adaptive_needs_success() -> None:
    needs = {
        name: make_strategy(CoachConfig(strategy=name)).needs_success
        for name in ("none", "fixed", "curriculum", "adaptive")
    }
    assert needs == {"none": False, "fixed": False, "curriculum": False, "adaptive": True}


class Alternating:
    """A user's own strategy: toggles between 0 and 0.5 at every block."""

    initial_rate = 0.0
    needs_success = True

    def next_rate(self, rate: float, success_rate: float | None, progress: Progress) -> float:
        return rate if success_rate is None else 0.5 - rate


@pytest.fixture
def own_strategy() -> Iterator[str]:
    strategies.register("alternating", lambda config: Alternating())
    yield "alternating"
    del strategies._FACTORIES["alternating"]


def test_a_registered_strategy_works_like_a_built_in_one(own_strategy: str) -> None:
    coach = Coach(CoachConfig(strategy=own_strategy), TEAM, seed=0)
    rates = [coach.record_block(1.0, NOWHERE).new_rate for _ in range(3)]
    assert rates == [0.5, 0.0, 0.5]
    with pytest.raises(ValueError, match="registered already"):
        strategies.register(own_strategy, lambda config: Alternating())


def make_alternating(config: CoachConfig) -> Alternating:
    return Alternating()


def test_an_installed_strategy_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("theirs", f"{__name__}:make_alternating", strategies.ENTRY_POINT_GROUP)
    monkeypatch.setattr(strategies, "entry_points", lambda **_: (point,))
    coach = Coach(CoachConfig(strategy="theirs"), TEAM, seed=0)
    assert coach.record_block(1.0, NOWHERE).new_rate == 0.5


def test_a_success_rate_out_of_range_is_refused() -> None:
    coach = Coach(CoachConfig(strategy="adaptive"), TEAM, seed=0)
    with pytest.raises(ValueError, match=r"success rate 1\.5 is not in"):
        coach.record_block(1.5, NOWHERE)
    with pytest.raises(ValueError, match="success rate nan"):
        coach.record_block(float("nan"), NOWHERE)


def test_block_record_counts_training_episodes() -> None:
    config = CoachConfig(strategy="adaptive", beta=0.0, rho=1.0, crash_mode="random")
    coach = Coach(config, TEAM, seed=1)
    assert coach.record_block(1.0, NOWHERE).crashed_fraction is None
    plans = [coach.plan(episode) for episode in range(10)]
    for plan in plans:
        coach.count(plan)
    record = coach.record_block(1.0, NOWHERE)
    assert (record.rate, record.cap, record.episodes) == (1.0, 3, 10)
    assert record.crashed_fraction == 1.0
    assert coach.record_block(1.0, NOWHERE).episodes == 0


def test_a_role_is_the_whole_of_the_crash_fraction() -> None:
    team = TeamSpec(TEAM.robots, ("scout", "scout", "hauler"))
    coach = Coach(CoachConfig(strategy="fixed", crash_rate=1.0, victim_role="scout"), team, 1)
    for episode in range(5):
        coach.count(coach.plan(episode))
    assert coach.record_block(1.0, NOWHERE).crashed_fraction == 1.0


@pytest.mark.parametrize(
    ("settings", "rate"),
    [
        ({"strategy": "adaptive"}, 0.6),
        ({"strategy": "adaptive", "alpha_max": 0.5}, 0.5),
        ({"strategy": "fixed", "crash_rate": 0.2, "alpha_max": 0.1}, 0.2),
        ({"strategy": "curriculum", "curriculum_delta": 0.01}, 0.04),
    ],
)
def test_another_coachs_rate_goes_on_where_the_strategy_depends_on_it(
    settings: dict[str, Any], rate: float
) -> None:
    coach = Coach(CoachConfig(**settings), TEAM, seed=0)
    coach.resume(0.6, Progress(env_steps=0, total_steps=0, episodes=4))
    assert coach.rate == pytest.approx(rate)


def test_state_survives_json_and_continues_alike() -> None:
    config = CoachConfig(strategy="adaptive", rho=0.1)
    coach = Coach(config, TEAM, seed=5)
    for episode, success in enumerate((1.0, 0.3, 0.9)):
        coach.count(coach.plan(episode))
        coach.record_block(success, NOWHERE)
    coach.count(coach.plan(9))
    copy = Coach(config, TEAM, seed=5)
    copy.load_state_dict(json.loads(json.dumps(coach.state_dict())))
    assert [copy.plan(e) for e in range(50)] == [coach.plan(e) for e in range(50)]
    assert copy.record_block(0.8, NOWHERE) == coach.record_block(0.8, NOWHERE)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"rate": 0.1}, "expected"),
        ({"rate": 2.0, "revision": 0, "episodes": 0, "crashed": 0}, "rate 2.0"),
    ],
)
def test_a_foreign_state_is_refused(state: dict[str, int | float], message: str) -> None:
    coach = Coach(CoachConfig(strategy="adaptive"), TEAM, seed=5)
    with pytest.raises(ValueError, match=message):
        coach.load_state_dict(state)
