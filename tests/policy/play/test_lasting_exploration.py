"""Random actions that last: how long, how often, and when they end."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest

from policy_pkg.act import Explorer, greedy

ARENAS, ROBOTS, ACTIONS, LONGEST = 400, 3, 64, 6
BEST = 0  # the greedy action; a random one is another in 63 of 64 draws


def chosen(epsilon: float, steps: int, longest: int = LONGEST) -> npt.NDArray[np.int32]:
    """(steps, ARENAS, ROBOTS) choices where every action is available and BEST is greedy."""
    q = np.zeros((ARENAS, ROBOTS, ACTIONS), dtype=np.float32)
    q[..., BEST] = 1
    available = np.ones(q.shape, dtype=np.bool_)
    explorer, rng = Explorer(ARENAS, ROBOTS, longest), np.random.default_rng(3)
    return np.array([explorer.choose(q, available, epsilon, rng) for _ in range(steps)])


def test_durations_follow_their_law() -> None:
    """P(d) is proportional to 1 / (d (d + 1)) up to the longest; runs of a held action are d."""
    actions = chosen(0.1, 400).reshape(400, -1)
    lengths = []
    for row in actions.T:
        ends = np.flatnonzero(np.diff(row)) + 1
        for begin, end in pairwise(ends):
            if row[begin] != BEST:
                lengths.append(end - begin)
    steps = np.arange(1, LONGEST + 1)
    law = 1 / (steps * (steps + 1)) / np.sum(1 / (steps * (steps + 1)))
    found = np.bincount(lengths, minlength=LONGEST + 1)[1 : LONGEST + 1] / len(lengths)
    assert len(lengths) > 20_000
    # Two random actions in a row are the same one in 1 of 64 cases: a longer run.
    np.testing.assert_allclose(found, law, atol=0.012)


@pytest.mark.parametrize("epsilon", [0.05, 0.2, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("longest", [1, 2, 6, 40])
def test_epsilon_is_the_share_of_random_steps(epsilon: float, longest: int) -> None:
    random = chosen(epsilon, 300, longest)[60:] != BEST
    assert random.mean() == pytest.approx(epsilon * (1 - 1 / ACTIONS), abs=0.012)


def test_an_action_that_is_not_available_any_more_ends_the_hold() -> None:
    rng = np.random.default_rng(5)
    explorer = Explorer(200, 2, 50)
    for _ in range(300):
        q = rng.standard_normal((200, 2, 5)).astype(np.float32)
        available = rng.random(q.shape) < 0.5
        available[..., 4] = True
        action = explorer.choose(q, available, 0.6, rng)
        assert np.take_along_axis(available, action[..., None], -1).all()


def test_nothing_is_held_into_the_next_episode() -> None:
    q = np.zeros((50, 2, 4), dtype=np.float32)
    available = np.ones(q.shape, dtype=np.bool_)
    explorer, rng = Explorer(50, 2, 1000), np.random.default_rng(6)
    explorer.choose(q, available, 1.0, rng)
    assert (explorer.left > 0).any()
    explorer.begin(np.arange(0, 50, 2))
    assert not explorer.left[::2].any()
    assert explorer.left[1::2].any()
    assert (explorer.choose(q, available, 0.0, rng)[::2] == greedy(q, available)[::2]).all()


def test_a_longest_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="longest random action: 0 steps"):
        Explorer(1, 1, 0)
