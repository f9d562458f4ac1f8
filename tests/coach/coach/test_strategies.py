"""The crash rate's path against the formulas of the paper, worked out by hand."""

from __future__ import annotations

import json
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from typing import Any

import pytest

from crash_coach_common import plugins
from crash_coach_pkg.coach import strategies
from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.coach.strategies import find_strategy, strategy_names
from crash_coach_pkg.coach.strategies.base import BlockOver, Draws, Progress, State, Strategy
from crash_coach_pkg.plan import CrashPlan
from crash_coach_pkg.team import TeamSpec

TEAM = TeamSpec(("robot_1", "robot_2", "robot_3"))
NOWHERE = Progress(env_steps=0, total_steps=0, episodes=0)


def advance(coach: Coach, progress: Progress) -> None:
    """An episode without crashes."""
    coach.finish(CrashPlan(0, 0, 0, 0.0, 0), True, progress)


def test_adaptive_path_equals_the_formula() -> None:
    coach = Coach(
        CoachConfig(strategy="adaptive", adaptive={"beta": 0.75, "rho": 0.1}), TEAM, seed=0
    )
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
    free = Coach(CoachConfig(strategy="adaptive", adaptive={"rho": 0.1}), TEAM, seed=0)
    ceiling = {"rho": 0.1, "alpha_max": 0.3}
    capped = Coach(CoachConfig(strategy="adaptive", adaptive=ceiling), TEAM, seed=0)
    for _ in range(200):
        free.record_block(1.0, NOWHERE)
        capped.record_block(1.0, NOWHERE)
    assert free.rate > 0.999
    assert capped.rate == 0.3
    assert capped.record_block(1.0, NOWHERE).decision == "keep"


def test_adaptive_moves_only_at_blocks() -> None:
    coach = Coach(CoachConfig(strategy="adaptive"), TEAM, seed=0)
    advance(coach, Progress(env_steps=10**6, total_steps=10**6, episodes=10**5))
    assert coach.rate == 0.0


def test_patient_waits_for_a_block_and_never_again() -> None:
    config = CoachConfig(strategy="patient", crash_rate=0.4, patient={"success": 0.8})
    coach = Coach(config, TEAM, seed=0)
    rates = [coach.record_block(success, NOWHERE).new_rate for success in (0.5, 0.79, 0.8, 0.0)]
    assert rates == [0.0, 0.0, 0.4, 0.4]
    fixed = Coach(CoachConfig(strategy="fixed", crash_rate=0.4), TEAM, seed=0)
    assert [coach.plan(i).faults for i in range(200)] == [fixed.plan(i).faults for i in range(200)]


def test_patient_crashes_nobody_before() -> None:
    coach = Coach(CoachConfig(strategy="patient", crash_rate=0.9), TEAM, seed=0)
    coach.record_block(0.7, NOWHERE)
    assert not any(coach.plan(episode).faults for episode in range(200))


@pytest.mark.parametrize(("steps", "rate"), [(0, 0.0), (250, 0.05), (500, 0.1), (1000, 0.1)])
def test_curriculum_in_environment_steps(steps: int, rate: float) -> None:
    coach = Coach(CoachConfig(strategy="curriculum"), TEAM, seed=0)
    advance(coach, Progress(env_steps=steps, total_steps=1000, episodes=7))
    assert coach.rate == pytest.approx(rate)


def test_curriculum_moves_at_blocks_too() -> None:
    coach = Coach(CoachConfig(strategy="curriculum"), TEAM, seed=0)
    coach.record_block(0.5, Progress(env_steps=250, total_steps=1000, episodes=0))
    assert coach.rate == pytest.approx(0.05)


@pytest.mark.parametrize(("episodes", "rate"), [(0, 0.0), (10, 0.02), (200, 0.4), (1000, 0.4)])
def test_curriculum_per_episode(episodes: int, rate: float) -> None:
    config = CoachConfig(strategy="curriculum", curriculum={"episodes": 200, "alpha_max": 0.4})
    coach = Coach(config, TEAM, seed=0)
    advance(coach, Progress(env_steps=0, total_steps=0, episodes=episodes))
    assert coach.rate == pytest.approx(rate)


def test_curriculum_needs_a_length_of_training() -> None:
    coach = Coach(CoachConfig(strategy="curriculum"), TEAM, seed=0)
    with pytest.raises(ValueError, match=r"length of training is unknown.*curriculum.episodes"):
        advance(coach, NOWHERE)


def test_curriculum_alone_crashes_robots() -> None:
    coach = Coach(CoachConfig(strategy="curriculum"), TEAM, seed=3)
    crashed = [0, 0]
    for episode in range(2000):
        advance(coach, Progress(env_steps=episode, total_steps=2000, episodes=episode))
        crashed[episode >= 1000] += len(coach.plan(episode).faults)
    assert 0 < crashed[0] < crashed[1]
    # At alpha 0.1 and cap 1: P(1) = .243/(.729+.243) = .25.
    assert crashed[1] / 1000 == pytest.approx(0.25, abs=0.05)


def test_fixed_and_none() -> None:
    fixed = Coach(CoachConfig(strategy="fixed", crash_rate=0.4), TEAM, seed=0)
    assert fixed.record_block(0.0, NOWHERE).new_rate == 0.4
    none = Coach(CoachConfig(strategy="none", crashed_exactly=1), TEAM, seed=0)
    assert all(not none.plan(episode).faults for episode in range(100))


def test_what_a_strategy_reads() -> None:
    found = {name: find_strategy(name) for name in strategy_names()}
    assert {name for name, it in found.items() if it.needs_success} == {
        "adaptive", "patient", "learnability", "failure",
    }  # fmt: skip
    assert {name for name, it in found.items() if it.reads_blocks} == {"adaptive", "patient"}
    assert {name for name, it in found.items() if not it.crashes} == {"none"}


class Alternating(Strategy[Any]):
    """A user's own strategy: everybody crashes, or nobody, by turns from block to block."""

    name = "alternating"
    summary = "All or nobody."
    needs_success = True
    _all = False

    @property
    def rate(self) -> float:
        return float(self._all)

    def plan(self, episode: int, draws: Draws) -> tuple[int, ...]:
        return tuple(range(self.candidates.n)) if self._all else ()

    def block_over(self, over: BlockOver) -> None:
        self._all = not self._all

    def state_dict(self) -> State:
        return {"all": self._all}

    def load_state_dict(self, state: State) -> None:
        self.check_keys(state)
        self._all = bool(state["all"])


@pytest.fixture
def own_strategy() -> Iterator[str]:
    strategies.register(Alternating)
    yield Alternating.name
    del strategies._strategies[Alternating.name]


def test_a_registered_strategy_works_like_a_built_in_one(own_strategy: str) -> None:
    config = CoachConfig(strategy=own_strategy)
    coach = Coach(config, TEAM, seed=0)
    rates = [coach.record_block(1.0, NOWHERE).new_rate for _ in range(3)]
    assert rates == [1.0, 0.0, 1.0]
    copy = Coach(config, TEAM, seed=0)
    copy.load_state_dict(json.loads(json.dumps(coach.state_dict())))
    assert copy.plan(4) == coach.plan(4)
    assert len(copy.plan(4).faults) == 3
    with pytest.raises(ValueError, match="name is taken"):
        strategies.register(Alternating)


def test_a_strategy_that_breaks_the_limits_is_named(own_strategy: str) -> None:
    coach = Coach(CoachConfig(strategy=own_strategy, min_alive=1), TEAM, seed=0)
    coach.record_block(1.0, NOWHERE)
    with pytest.raises(ValueError, match=r"'alternating' crashes \[0, 1, 2\].*at most 2"):
        coach.plan(0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "Mine"}, "lower-case"),
        ({"name": "adaptive"}, "taken by"),
        ({"name": "mute"}, "taken by a fault mode"),
        ({"name": "stay"}, "taken by a fault mode"),
    ],
)
def test_what_cannot_be_registered(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        strategies.register(type("Changed", (Alternating,), changes))
    with pytest.raises(ValueError, match="is not a Strategy"):
        strategies.register(dict)  # type: ignore[arg-type]


def test_an_installed_strategy_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("theirs", f"{__name__}:Alternating", strategies.ENTRY_POINT_GROUP)
    monkeypatch.setattr(plugins, "entry_points", lambda **_: (point,))
    monkeypatch.setattr(strategies, "_installed_read", False)
    monkeypatch.setattr(strategies, "_strategies", dict(strategies._strategies))
    coach = Coach(CoachConfig(strategy="alternating"), TEAM, seed=0)
    assert coach.record_block(1.0, NOWHERE).new_rate == 1.0


def test_a_success_rate_out_of_range_is_refused() -> None:
    coach = Coach(CoachConfig(strategy="adaptive"), TEAM, seed=0)
    with pytest.raises(ValueError, match=r"success rate 1\.5 is not in"):
        coach.record_block(1.5, NOWHERE)
    with pytest.raises(ValueError, match="success rate nan"):
        coach.record_block(float("nan"), NOWHERE)


def test_block_record_counts_training_episodes() -> None:
    config = CoachConfig(
        strategy="adaptive", adaptive={"beta": 0.0, "rho": 1.0}, crash_mode="random"
    )
    coach = Coach(config, TEAM, seed=1)
    assert coach.record_block(1.0, NOWHERE).crashed_fraction is None
    plans = [coach.plan(episode) for episode in range(10)]
    for plan in plans:
        coach.finish(plan, True, NOWHERE)
    record = coach.record_block(1.0, NOWHERE)
    assert (record.rate, record.cap, record.episodes) == (1.0, 3, 10)
    assert record.crashed_fraction == 1.0
    assert coach.record_block(1.0, NOWHERE).episodes == 0


def test_a_role_is_the_whole_of_the_crash_fraction() -> None:
    team = TeamSpec(TEAM.robots, ("scout", "scout", "hauler"))
    coach = Coach(CoachConfig(strategy="fixed", crash_rate=1.0, victim_role="scout"), team, 1)
    for episode in range(5):
        coach.finish(coach.plan(episode), True, NOWHERE)
    assert coach.record_block(1.0, NOWHERE).crashed_fraction == 1.0


@pytest.mark.parametrize(
    ("settings", "rate"),
    [
        ({"strategy": "adaptive"}, 0.6),
        ({"strategy": "adaptive", "adaptive": {"alpha_max": 0.5}}, 0.5),
        ({"strategy": "fixed", "crash_rate": 0.2}, 0.2),
        ({"strategy": "curriculum", "curriculum": {"episodes": 10}}, 0.04),
    ],
)
def test_another_coachs_rate_goes_on_where_the_strategy_depends_on_it(
    settings: dict[str, Any], rate: float
) -> None:
    coach = Coach(CoachConfig(**settings), TEAM, seed=0)
    coach.resume(0.6, Progress(env_steps=0, total_steps=0, episodes=4))
    assert coach.rate == pytest.approx(rate)


def test_state_survives_json_and_continues_alike() -> None:
    config = CoachConfig(strategy="adaptive", adaptive={"rho": 0.1})
    coach = Coach(config, TEAM, seed=5)
    for episode, success in enumerate((1.0, 0.3, 0.9)):
        coach.finish(coach.plan(episode), True, NOWHERE)
        coach.record_block(success, NOWHERE)
    coach.finish(coach.plan(9), True, NOWHERE)
    copy = Coach(config, TEAM, seed=5)
    copy.load_state_dict(json.loads(json.dumps(coach.state_dict())))
    assert [copy.plan(e) for e in range(50)] == [coach.plan(e) for e in range(50)]
    assert copy.record_block(0.8, NOWHERE) == coach.record_block(0.8, NOWHERE)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"strategy": {"rate": 0.1}}, "expected"),
        ({"strategy": {}, "revision": 0, "episodes": 0, "crashed": 0}, "expected .'rate'"),
        ({"strategy": {"rate": 2}, "revision": 0, "episodes": 0, "crashed": 0}, "rate 2.0"),
    ],
)
def test_a_foreign_state_is_refused(state: State, message: str) -> None:
    coach = Coach(CoachConfig(strategy="adaptive"), TEAM, seed=5)
    with pytest.raises(ValueError, match=message):
        coach.load_state_dict(state)
