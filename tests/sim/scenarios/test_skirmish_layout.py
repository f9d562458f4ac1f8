"""The skirmish's numbers are where SMAC has them."""

from __future__ import annotations

import numpy as np
import pytest

from sim_pkg.scenarios.skirmish.layout import FIRST_ATTACK, Layout

SHIELDED = ("stalker", "zealot")


def team(text: str) -> list[str]:
    """ "3s5z" -> three stalkers and five zealots."""
    names = {"m": "marine", "s": "stalker", "z": "zealot"}
    return [
        names[kind] for k, kind in zip(text[::2], text[1::2], strict=True) for _ in range(int(k))
    ]


@pytest.mark.parametrize(
    ("robots", "opponents", "obs_size", "state_size", "n_actions"),
    [
        ("3s", "5z", 48, 68, 11),
        ("3s5z", "3s5z", 128, 216, 14),
        ("8m", "5z", 70, 140, 11),
        ("8s", "3s5z", 128, 216, 14),
        ("3m", "3m", 30, 48, 9),
        ("8m", "8m", 80, 168, 14),
        ("2s3z", "2s3z", 80, 120, 11),
        ("3s", "3z", 36, 54, 9),
    ],
)
def test_sizes(robots: str, opponents: str, obs_size: int, state_size: int, n_actions: int) -> None:
    layout = Layout.of(team(robots), team(opponents), SHIELDED)
    assert (layout.obs_size, layout.state_size) == (obs_size, state_size)
    assert layout.n_actions == len(layout.action_names) == n_actions
    assert layout.action_names[FIRST_ATTACK] == "attack_1"


def test_splitting_is_by_view_and_leaves_nothing_out() -> None:
    layout = Layout.of(team("3s5z"), team("3s5z"), SHIELDED)
    obs = np.zeros((2, 8, layout.obs_size), dtype=np.float32)
    parts = layout.split_obs(obs)
    assert parts.opponents.shape == (2, 8, 8, 8)
    assert parts.allies.shape == (2, 8, 7, 8)
    assert parts.own.shape == (2, 8, 4)
    for part in (parts.moves, parts.opponents, parts.allies, parts.own):
        part += 1.0
    np.testing.assert_array_equal(obs, 1.0)
    state = np.zeros((2, layout.state_size), dtype=np.float32)
    split = layout.split_state(state)
    assert split.robots.shape == (2, 8, 7)
    assert split.opponents.shape == (2, 8, 6)
    assert split.last_actions.shape == (2, 8, 14)
    for part in (split.robots, split.opponents, split.last_actions):
        part += 1.0
    np.testing.assert_array_equal(state, 1.0)


def test_type_bits_where_a_team_is_mixed() -> None:
    layout = Layout.of(team("8s"), team("3s5z"), SHIELDED)
    assert layout.type_names == ("stalker", "zealot")
    assert layout.type_bits("zealot").tolist() == [0.0, 1.0]
    assert Layout.of(team("3s"), team("5z"), SHIELDED).type_names == ()
