"""The open-loop control: what its teams may know, and that the search finds what there is."""

from __future__ import annotations

import numpy as np
import pytest

from sim_pkg.env import make_env
from sim_pkg.open_loop import OpenLoopTeam, Search, play, search

QUICK = Search(generations=12, first_teams=64, teams=16, episodes=2, compared_on=2)


@pytest.mark.parametrize("masked", [True, False])
def test_it_finds_the_shortest_way_where_nothing_has_to_be_seen(masked: bool) -> None:
    """On buttons nothing is drawn: a list of actions is all it takes."""
    env = make_env("buttons", QUICK.arenas)
    team = search(env, masked, 3, QUICK)
    again = search(env, masked, 3, QUICK)
    np.testing.assert_array_equal(team.scores, again.scores)
    score = play(team, env, 1 << 62, range(5))
    assert (score.wins, score.episodes) == (5, 5)
    assert score.steps_mean <= 8


def test_a_team_without_the_mask_stays_where_it_cannot_do_what_it_wants() -> None:
    env = make_env("skirmish/3m", 4)
    env.reset(np.arange(4), 0, np.arange(4))
    attack = np.zeros((3, 20, env.spec.n_actions))
    attack[..., -1] = 1.0  # far out of reach at first
    attack[..., 4] = 0.5  # east
    assert not env.available[..., -1].any()
    blind = OpenLoopTeam(attack, masked=False).act(0, env.available, env)
    assert set(blind.ravel().tolist()) == {env.spec.stay_actions[0]} or not (blind == 4).any()
    assert (OpenLoopTeam(attack, masked=True).act(0, env.available, env) == 4).all()
    assert np.take_along_axis(env.available, blind[..., None], axis=-1).all()


def test_the_order_changes_with_the_time_and_not_with_the_arena() -> None:
    env = make_env("buttons", 3)
    env.reset(np.arange(3), 0, np.arange(3))
    scores = np.zeros((2, 20, env.spec.n_actions))
    for step in range(20):
        scores[:, step, step % 5] = 1.0
    team = OpenLoopTeam(scores, masked=True)
    for step in range(7):
        actions = team.act(step, np.ones_like(env.available), env)
        assert (actions == step % 5).all()
