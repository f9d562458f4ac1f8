"""The laws of the strategies' draws, and what all strategies owe: limits, purity, their state."""

from __future__ import annotations

import json
import random
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.coach.strategies import find_strategy, settings_of, strategy_names
from crash_coach_pkg.coach.strategies.base import Candidates, Draws, EpisodeOver, Progress
from crash_coach_pkg.coach.strategies.deck import Deck, DeckSettings
from crash_coach_pkg.coach.strategies.failure import Failure, FailureSettings
from crash_coach_pkg.coach.strategies.learnability import Learnability, LearnabilitySettings
from crash_coach_pkg.team import TeamSpec

DRAWS = 20_000
WHERE = Progress(env_steps=500, total_steps=1000, episodes=50)
TEAM = TeamSpec(tuple(f"robot_{i + 1}" for i in range(5)))
Fits = Callable[..., bool]


def dealt(deck: Deck, episodes: int, seed: int = 0) -> list[tuple[int, ...]]:
    return [deck.plan(episode, Draws(seed)) for episode in range(episodes)]


def test_a_decks_shares_are_exact_and_its_order_is_not(fits: Fits) -> None:
    settings = DeckSettings(nobody=4, one=3, two=2, three=1)
    plans = dealt(Deck(settings, Candidates(8, 8)), DRAWS)
    sizes = np.array([len(plan) for plan in plans]).reshape(-1, 10)
    for size, count in enumerate((4, 3, 2, 1)):
        assert ((sizes == size).sum(axis=1) == count).all()
    # Where in its deck the only card of its kind lies is uniform, whatever the deck before.
    places = (sizes == 3).argmax(axis=1)
    assert fits(np.bincount(places, minlength=10), len(places) / 10)
    pairs = Counter(pairwise(places.tolist()))
    assert fits([pairs[i, j] for i in range(10) for j in range(10)], (len(places) - 1) / 100)


@pytest.mark.parametrize(("n", "size"), [(8, 1), (8, 2), (8, 3), (3, 2), (2, 1), (5, 3)])
def test_a_decks_victims_come_in_turn(n: int, size: int, fits: Fits) -> None:
    """Of n cards with k robots each robot is in exactly k, and the turns differ."""
    kind = {1: "one", 2: "two", 3: "three"}[size]
    settings = DeckSettings(**{**dict.fromkeys(("nobody", "one", "two", "three"), 0), kind: 1})
    plans = dealt(Deck(settings, Candidates(n, n)), 2000 * n, seed=7)
    victims = np.array(plans).reshape(-1, n * size)
    assert (np.apply_along_axis(np.bincount, 1, victims, minlength=n) == size).all()
    robots = Counter(robot for plan in plans[::n] for robot in plan)  # each turn's first card
    assert fits([robots[i] for i in range(n)], 2000 * size / n)


def test_a_deck_leaves_out_what_the_limits_forbid() -> None:
    deck = Deck(DeckSettings(), Candidates(2, 1))
    sizes = [len(plan) for plan in dealt(deck, 400)]
    assert (sizes.count(0), sizes.count(1), deck.cap, deck.rate) == (200, 200, 1, 0.25)
    assert not any(dealt(Deck(DeckSettings(nobody=0), Candidates(3, 0)), 30))


def test_learnability_follows_p_times_one_minus_p(fits: Fits) -> None:
    strategy = Learnability(LearnabilitySettings(), Candidates(3, 2))
    success = [0.9, 0.5, 0.0, 1.0, 0.2]  # nobody, robots 0 to 2, a pair
    strategy.load_state_dict({"success": success, "counts": [9] * 5})
    chosen = Counter(strategy.plan(episode, Draws(11)) for episode in range(DRAWS))
    weights = [p * (1 - p) for p in success]
    arms = [0.5 / 5 + 0.5 * w / sum(weights) for w in weights]
    pairs = [(0, 1), (0, 2), (1, 2)]
    expected = [*arms[:4], *(arms[4] / 3 for _ in pairs)]
    observed = [chosen[who] for who in ((), (0,), (1,), (2,), *pairs)]
    assert sum(observed) == DRAWS
    assert fits(observed, np.array(expected) * DRAWS)
    mean = sum(len(who) * count for who, count in chosen.items()) / (3 * DRAWS)
    assert strategy.rate == pytest.approx((sum(arms[1:4]) + 2 * arms[4]) / 3)
    assert mean == pytest.approx(strategy.rate, abs=0.005)


def test_failure_follows_the_failures_with_a_floor(fits: Fits) -> None:
    strategy = Failure(FailureSettings(floor=0.2), Candidates(2, 1))
    strategy.load_state_dict({"success": [1.0, 0.9, 0.25], "counts": [9] * 3})
    chosen = Counter(strategy.plan(episode, Draws(12)) for episode in range(DRAWS))
    weights = np.array([0.2, 0.2, 0.75])
    assert fits([chosen[who] for who in ((), (0,), (1,))], weights / weights.sum() * DRAWS)


def test_what_succeeds_everywhere_is_drawn_evenly() -> None:
    strategy = Learnability(LearnabilitySettings(), Candidates(2, 1))
    strategy.load_state_dict({"success": [1.0, 0.0, 1.0], "counts": [9] * 3})
    assert strategy.weights(np.array([1.0, 0.0, 1.0])) == pytest.approx([1 / 3] * 3)


def test_the_running_success_is_the_mean_until_the_memory_is_full() -> None:
    strategy = Failure(FailureSettings(memory_episodes=4), Candidates(3, 2))
    for success in (True, True, False):
        strategy.episode_over(EpisodeOver((1,), success, WHERE))
    # 1/2 counts as one episode: (0.5 + 1 + 1 + 0) / 4.
    assert strategy.state_dict()["success"][2] == pytest.approx(0.625)
    strategy.episode_over(EpisodeOver((1,), True, WHERE))
    assert strategy.state_dict()["success"][2] == pytest.approx(0.625 + 0.375 / 4)
    for crashed, arm in (((), 0), ((0, 2), 4)):
        strategy.episode_over(EpisodeOver(crashed, True, WHERE))
        assert strategy.state_dict()["success"][arm] == 0.75
    before = strategy.state_dict()
    strategy.episode_over(EpisodeOver((0, 1, 2), True, WHERE))  # somebody named the victims
    assert strategy.state_dict() == before


def coach(strategy: str, seed: int = 3, team: TeamSpec = TEAM, **settings: Any) -> Coach:
    """After some episodes and blocks, of which some succeeded."""
    made = Coach(CoachConfig(strategy=strategy, **{"crash_rate": 0.5, **settings}), team, seed)
    for episode in range(40):
        made.finish(made.plan(episode), episode % 3 == 0, WHERE)
        if episode % 10 == 9:
            made.record_block(0.9, WHERE, 1.0, (0.5,) * team.n)
    return made


def crashed(made: Coach, episodes: range = range(300)) -> list[tuple[int, ...]]:
    return [tuple(fault.robot for fault in made.plan(episode).faults) for episode in episodes]


@pytest.mark.parametrize("name", strategy_names())
class TestEvery:
    def test_keeps_the_limits(self, name: str) -> None:
        for limits in ({"min_alive": 4}, {"max_crashed": 1}, {"max_crashed": 2}, {"min_alive": 5}):
            made = coach(name, **limits)
            allowed = min(limits.get("max_crashed", 5), 5 - limits.get("min_alive", 0))
            assert max(map(len, crashed(made))) <= allowed
            assert made.plan(0).cap <= allowed

    def test_keeps_to_the_role(self, name: str) -> None:
        team = TeamSpec(TEAM.robots, ("scout", "hauler", "scout", "hauler", "hauler"))
        assert set().union(*crashed(coach(name, team=team, victim_role="scout"))) <= {0, 2}

    def test_plans_the_same_in_any_order(self, name: str) -> None:
        made, numbers = coach(name), list(range(300))
        forward = {number: made.plan(number) for number in numbers}
        random.Random(0).shuffle(numbers)
        assert {number: made.plan(number) for number in numbers} == forward
        other = [made.keyed(4).plan(number) for number in range(300)]
        assert [plan.seed for plan in other] == [4] * 300
        if any(plan.faults for plan in other):
            assert [plan.faults for plan in other] != [p.faults for p in forward.values()]

    def test_goes_on_from_its_state_as_json(self, name: str) -> None:
        first = coach(name)
        copy = Coach(first.config, TEAM, 3)
        copy.load_state_dict(json.loads(json.dumps(first.state_dict())))
        for episode in range(40, 100):
            plan = first.plan(episode)
            assert copy.plan(episode) == plan
            for made in (first, copy):
                made.finish(plan, episode % 2 == 0, WHERE)
            if episode % 20 == 0:
                assert first.record_block(0.3, WHERE) == copy.record_block(0.3, WHERE)
        assert copy.state_dict() == first.state_dict()
        with pytest.raises(ValueError, match=f"strategy {name} has keys"):
            copy.load_state_dict({**first.state_dict(), "strategy": {"x": 1}})

    def test_other_settings_go_on_from_the_state(self, name: str) -> None:
        first = coach(name)
        tighter = first.reconfigured(
            first.config.model_copy(update={"max_crashed": 1, "crash_mode": "random"}), 3
        )
        before, now = first.state_dict()["strategy"], tighter.state_dict()["strategy"]
        kept = {key: value[: len(value) - 1] if isinstance(value, list) else value
                for key, value in before.items()}  # fmt: skip
        assert now == kept  # without the pair, which may no longer crash
        assert max(map(len, crashed(tighter))) <= 1

    def test_says_what_it_is(self, name: str) -> None:
        strategy = find_strategy(name)
        assert strategy.summary.endswith(".")
        for info in settings_of(strategy):
            assert info.low <= info.default <= info.high
            assert info.description.endswith(".")
