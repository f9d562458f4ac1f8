"""What is drawn from a replay that is stratified."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from reference_learner import random_episode

from policy_pkg.episode import Sizes
from policy_pkg.learner.replay import Replay
from policy_pkg.learner.strata import Strata

SIZES = Sizes(n_robots=2, n_actions=3, obs_size=4, state_size=5, episode_limit=6)
# (robots crashed, success): how many episodes
CONTENT = {((), True): 70, ((), False): 20, ((0,), False): 8, ((0,), True): 1, ((1,), False): 1}


def filled(strata: Strata, capacity: int = 100) -> Replay:
    rng, replay = np.random.default_rng(0), Replay(capacity, SIZES, strata)
    for (crashed, success), count in CONTENT.items():
        for _ in range(count):
            episode = random_episode(SIZES, rng, int(rng.integers(2, 7)), terminated=True)
            episode.faults[1:, list(crashed)] = 2  # from the second step on
            replay.add(episode, success)
    return replay


def shares(replay: Replay) -> list[float]:
    """Probability of each kind of episode, in the order of CONTENT."""
    edges = np.cumsum([0, *CONTENT.values()])
    chances = replay.probabilities()
    return [float(chances[a:b].sum()) for a, b in pairwise(edges)]


@pytest.mark.parametrize(
    ("strata", "even"),
    [
        ("none", [0.70, 0.20, 0.08, 0.01, 0.01]),
        # three strata: nobody, robot 0, robot 1
        ("crashed", [1 / 3 * 7 / 9, 1 / 3 * 2 / 9, 1 / 3 * 8 / 9, 1 / 3 / 9, 1 / 3]),
        ("outcome", [0.2, 0.2, 0.2, 0.2, 0.2]),
    ],
)
def test_half_is_uniform_and_half_is_even_over_the_strata(
    strata: Strata, even: list[float]
) -> None:
    uniform = [0.70, 0.20, 0.08, 0.01, 0.01]
    expected = [(a + b) / 2 for a, b in zip(uniform, even, strict=True)]
    assert shares(filled(strata)) == pytest.approx(expected)


def test_draws_follow_the_probabilities_and_hold_no_episode_twice() -> None:
    replay, rng = filled("outcome"), np.random.default_rng(1)
    first = np.concatenate([replay.sample(rng, 1).slots for _ in range(20_000)])
    found = np.bincount(first, minlength=100) / len(first)
    np.testing.assert_allclose(found, replay.probabilities(), atol=0.01)
    for _ in range(50):
        assert len(set(replay.sample(rng, 32).slots.tolist())) == 32


def test_with_importance_weights_the_expected_loss_is_that_of_a_uniform_draw() -> None:
    replay, rng = filled("outcome"), np.random.default_rng(3)
    whole = replay.gather(np.arange(100))
    weights, chances = replay.importance(whole), replay.probabilities()[whole.slots]
    assert weights.max() <= 2
    assert chances * weights == pytest.approx(np.full(100, 0.01))
    batch = replay.sample(rng, 32)
    again = replay.importance(replay.gather(batch.slots))  # in the batch's order, longest first
    np.testing.assert_array_equal(replay.importance(batch), again)
    uniform = filled("none")
    assert set(uniform.importance(uniform.sample(rng, 8))) == {1.0}


def test_strata_follow_what_is_overwritten_and_a_round_trip() -> None:
    replay, rng = filled("outcome"), np.random.default_rng(2)
    for _ in range(98):  # over everything but the rare ones
        replay.add(random_episode(SIZES, rng, 3, terminated=True), True)
    # three strata are left: nobody crashed and a success, and one of each rare kind
    rare = 0.5 / 100 + 0.5 / 3
    assert replay.probabilities()[-2:] == pytest.approx([rare, rare])
    assert replay.probabilities()[:98].sum() == pytest.approx(1 - 2 * rare)
    again = Replay(100, SIZES, "outcome")
    again.load_state_dict(replay.state_dict())
    np.testing.assert_array_equal(again.probabilities(), replay.probabilities())
