"""Scripted skirmish policies: what they do in a given situation, and what it is worth.

The win rates hold the simulator to its decision problem: plain attacking loses where the paper's
teams had to learn more, and what they learned wins. docs/scenarios.md has the exact figures.
"""

from __future__ import annotations

import numpy as np
import pytest
from scripted_episodes import play

from sim_pkg.env import Env, make_env
from sim_pkg.scenarios.skirmish.layout import (
    EAST,
    FIRST_ATTACK,
    NO_OP,
    NORTH,
    SIGHT_M,
    STOP,
    WEST,
    Layout,
)
from sim_pkg.scripted import make_scripted

MAP = "skirmish/3s_vs_5z"
POLICIES = ("nearest", "focus", "kite", "alternate")


class Situation:
    """What one robot of 3s_vs_5z sees; the others are dead."""

    def __init__(self, policy: str) -> None:
        self.env: Env = make_env(MAP, 1)
        self.layout = Layout.of(["stalker"] * 3, ["zealot"] * 5, ["stalker", "zealot"])
        self.team = make_scripted(policy, self.env)
        self.team.begin(np.array([0]), 0, np.array([0]))
        self.obs = np.zeros_like(self.env.obs)
        self.available = np.zeros_like(self.env.available)
        self.available[..., NO_OP] = True
        self.available[0, 0] = False
        self.available[0, 0, STOP : WEST + 1] = True

    def place(self, opponent: int, x: float, y: float, health: float = 1.0) -> None:
        """An opponent without a shield at (x, y) m from robot_1."""
        part = self.layout.split_obs(self.obs).opponents[0, 0, opponent]
        away = float(np.hypot(x, y))
        part[:5] = away <= 6.0, away / SIGHT_M, x / SIGHT_M, y / SIGHT_M, health
        self.available[0, 0, FIRST_ATTACK + opponent] = away <= 6.0

    def act(self) -> int:
        actions = np.full((1, 3), -1, dtype=np.int32)
        self.team.act(self.obs, self.available, actions)
        assert actions[0, 1:].tolist() == [NO_OP, NO_OP]
        return int(actions[0, 0])


@pytest.mark.parametrize("policy", POLICIES)
def test_without_an_opponent_in_sight_it_goes_east(policy: str) -> None:
    seen = Situation(policy)
    assert seen.act() == EAST
    seen.available[0, 0, EAST] = False
    assert seen.act() == STOP


@pytest.mark.parametrize("policy", POLICIES)
def test_it_walks_to_the_nearest_in_sight(policy: str) -> None:
    seen = Situation(policy)
    seen.place(1, 8.0, 1.0)
    seen.place(3, -1.0, 7.0)
    assert seen.act() == NORTH


@pytest.mark.parametrize("policy", POLICIES)
def test_whom_it_attacks(policy: str) -> None:
    seen = Situation(policy)
    seen.place(1, 4.0, 0.0)
    seen.place(2, 5.0, 0.0, health=0.4)
    assert seen.act() == FIRST_ATTACK + (1 if policy == "nearest" else 2)


def test_kite_attacks_steps_back_until_its_weapon_is_ready_and_attacks_again() -> None:
    """A stalker's cooldown of 1.44 s is three steps."""
    seen = Situation("kite")
    seen.place(0, 5.0, 0.0)
    attack = FIRST_ATTACK
    assert [seen.act() for _ in range(7)] == [attack, WEST, WEST, attack, WEST, WEST, attack]


@pytest.mark.parametrize("policy", ["kite", "alternate"])
def test_it_runs_from_an_opponent_that_could_strike(policy: str) -> None:
    seen = Situation(policy)
    seen.place(0, 2.0, 0.0)
    assert [seen.act() for _ in range(5)] == [WEST] * 5
    seen.available[0, 0, WEST] = False  # a wall
    assert seen.act() == NORTH


def test_alternate_runs_only_where_no_ally_is_nearer() -> None:
    seen = Situation("alternate")
    seen.place(0, 2.0, 0.0)
    ally = seen.layout.split_obs(seen.obs).allies[0, 0, 0]
    ally[:5] = 1.0, 1.0 / SIGHT_M, 1.0 / SIGHT_M, 0.0, 1.0
    assert seen.act() == FIRST_ATTACK
    ally[:5] = 0.0
    assert seen.act() == WEST


def test_a_new_episode_forgets_the_last_attack() -> None:
    seen = Situation("kite")
    seen.place(0, 5.0, 0.0)
    assert [seen.act(), seen.act()] == [FIRST_ATTACK, WEST]
    seen.team.begin(np.array([0]), 0, np.array([1]))
    assert seen.act() == FIRST_ATTACK


@pytest.mark.parametrize("policy", POLICIES)
def test_same_bits_for_1_8_and_64_arenas(policy: str) -> None:
    one = play("skirmish/2s3z", policy, 8, muted=(0,), n_arenas=1).hashes
    assert len(set(one)) == 8
    assert play("skirmish/2s3z", policy, 8, muted=(0,), n_arenas=8).hashes == one
    assert play("skirmish/2s3z", policy, 8, muted=(0,), n_arenas=64).hashes == one


def wins(scenario: str, policy: str, muted: tuple[int, ...] = ()) -> float:
    """Win rate over 128 episodes."""
    return float(play(f"skirmish/{scenario}", policy, 128, muted).success.mean())


@pytest.mark.parametrize("scenario", ["3s_vs_5z", "3s5z_vs_3s5z", "8m_vs_5z", "8s_vs_3s5z"])
def test_random_and_hold_never_win(scenario: str) -> None:
    assert wins(scenario, "random") == 0
    assert wins(scenario, "hold") == 0


@pytest.mark.parametrize("scenario", ["3s_vs_5z", "3s_vs_3z"])
def test_stalkers_beat_zealots_by_kiting_only(scenario: str) -> None:
    assert wins(scenario, "kite") > 0.8
    assert wins(scenario, "nearest") == wins(scenario, "focus") == 0


def test_marines_beat_zealots_by_alternating_only() -> None:
    assert wins("8m_vs_5z", "alternate") > 0.45
    assert wins("8m_vs_5z", "nearest") == wins("8m_vs_5z", "focus") == 0
    assert wins("8m_vs_5z", "kite") < 0.2


def test_eight_stalkers_win_by_attacking_while_all_work() -> None:
    assert wins("8s_vs_3s5z", "focus") > 0.6
    assert wins("8s_vs_3s5z", "nearest") > 0.2
    for policy in ("focus", "nearest"):
        assert wins("8s_vs_3s5z", policy, muted=(2, 5)) < 0.05
