"""Each rule of the fight by itself, tick by tick; the numbers are those of units.yaml."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from skirmish_maps import Duel, Placed, load_map, write_map

from sim_pkg.env import make_env
from sim_pkg.scenarios.skirmish.layout import FIRST_ATTACK, STATE_COOLDOWN, STOP
from sim_pkg.scenarios.skirmish.tables import ALIVE, CHASE, HEALTH, HITTER, HURT, READY, SHIELD

TICK_S = 1 / 16
FAR = ("dummy", 30.0, 30.0)


def duel(folder: Path, robots: list[Placed], opponents: list[Placed], **changes: object) -> Duel:
    return Duel(load_map(write_map(folder, robots, opponents, **changes)))


def hits_of(fight: Duel, attacker: int, target: int, ticks: int) -> list[tuple[int, float]]:
    """(tick, damage) of everything that lands."""
    fight.attack(attacker, target)
    found = []
    for tick in range(ticks):
        damage = float(fight.tick()[attacker, target])
        if damage > 0:
            found.append((tick, damage))
    return found


def test_shield_first_and_armour_on_health_only(tmp_path: Path) -> None:
    """A marine's 6: eight times on the shield, then 2 on it and 4 - 1 on health, then 6 - 1."""
    fight = duel(tmp_path, [("marine", 10, 10)], [("dummy", 14, 10)])
    damage = [d for _, d in hits_of(fight, 0, 1, 1200)]
    assert damage[:10] == [6.0] * 8 + [5.0, 5.0]
    # 50 + 100 in all; the last hit takes no more than what is left (100 - 3 - 19 x 5 = 2).
    assert damage[8:] == [5.0] * 20 + [2.0]
    assert sum(damage) == 150.0
    assert not fight.fight.whole[0, 1, ALIVE]


def test_thick_armour_leaves_half_a_point(tmp_path: Path) -> None:
    thick = load_map(write_map(tmp_path, [("marine", 10, 10)], [FAR])).types["dummy"]
    tank = thick.model_dump(mode="json") | {"armour": 50.0, "shield": 0.0}
    fight = duel(tmp_path, [("marine", 10, 10)], [("tank", 14, 10)], unit_types={"tank": tank})
    assert {d for _, d in hits_of(fight, 0, 1, 100)} == {0.5}


def test_bonus_against_armoured(tmp_path: Path) -> None:
    fight = duel(tmp_path, [("stalker", 10, 10)], [("stalker", 14, 10), ("zealot", 13, 13)])
    assert hits_of(fight, 0, 1, 10)[0][1] == 14.0
    fight = duel(tmp_path, [("stalker", 10, 10)], [("stalker", 14, 10), ("zealot", 13, 13)])
    assert hits_of(fight, 0, 2, 10)[0][1] == 10.0


def test_a_stalkers_shot_leaves_late(tmp_path: Path) -> None:
    """0.167 s after the attack began: in the third tick after its first."""
    fight = duel(tmp_path, [("stalker", 10, 10)], [("dummy", 14, 10)])
    assert hits_of(fight, 0, 1, 20) == [(3, 10.0)]


def test_a_zealots_second_hit(tmp_path: Path) -> None:
    """0.28 s after the first: in the fifth tick."""
    fight = duel(tmp_path, [("zealot", 10, 10)], [("dummy", 11, 10)])
    assert hits_of(fight, 0, 1, 18) == [(0, 8.0), (5, 8.0)]


def test_a_second_hit_lands_on_who_walked_away(tmp_path: Path) -> None:
    fight = duel(tmp_path, [("zealot", 10, 10)], [("dummy", 11, 10)])
    fight.attack(0, 1)
    assert fight.tick()[0, 1] == 8.0
    fight.bodies[0, 1, 0] = 15.0
    assert sum(fight.tick()[0, 1] for _ in range(30)) == 8.0


@pytest.mark.parametrize(("unit", "cooldown_s"), [("marine", 0.8608), ("stalker", 1.44)])
def test_cooldown_and_its_random_extra(tmp_path: Path, unit: str, cooldown_s: float) -> None:
    tough = load_map(write_map(tmp_path, [("marine", 10, 10)], [FAR])).types["dummy"]
    tank = tough.model_dump(mode="json") | {"health": 1e6}
    fight = duel(tmp_path, [(unit, 10, 10)], [("tank", 14, 10)], unit_types={"tank": tank})
    ticks = np.array([tick for tick, _ in hits_of(fight, 0, 1, 1500)])
    between_s = np.diff(ticks) * TICK_S
    assert len(between_s) > 50
    # The next tick after the cooldown is over.
    assert between_s.min() >= cooldown_s - 0.0625
    assert between_s.max() <= cooldown_s + 0.125 + TICK_S
    assert len(set(between_s.tolist())) >= 3
    expected_s = cooldown_s + 0.03125 + TICK_S / 2
    assert between_s.mean() == pytest.approx(expected_s, abs=0.04)


def test_shields_come_back_ten_seconds_after_the_last_damage(tmp_path: Path) -> None:
    fight = duel(tmp_path, [("marine", 10, 10)], [("dummy", 14, 10)])
    fight.attack(0, 1)
    fight.tick()
    fight.attack(0, -1)
    fight.order([STOP])
    real = fight.fight.real[0, 1]
    for _ in range(160):
        fight.tick()
        assert real[SHIELD] == 44.0
    for _ in range(16):
        fight.tick()
    assert real[SHIELD] == pytest.approx(46.0)
    for _ in range(100):
        fight.tick()
    assert real[SHIELD] == 50.0
    real[HURT], real[HEALTH] = fight.fight.clock_s[0], 50.0
    for _ in range(400):
        fight.tick()
    assert real[HEALTH] == 50.0, "health never comes back"


@pytest.mark.parametrize(
    ("unit", "reach_m"),
    [("marine", 5 + 0.375 + 0.5), ("stalker", 6 + 0.625 + 0.5), ("zealot", 0.1 + 0.5 + 0.5)],
)
def test_reach_is_edge_to_edge(tmp_path: Path, unit: str, reach_m: float) -> None:
    near = duel(tmp_path, [(unit, 10, 10)], [("dummy", 10 + reach_m - 0.001, 10)])
    assert hits_of(near, 0, 1, 8)
    far = duel(tmp_path, [(unit, 10, 10)], [("dummy", 10 + reach_m + 0.001, 10)])
    assert not hits_of(far, 0, 1, 8)
    # Who is out of reach walks in, and not much farther than it must.
    velocity = far.plan()[0]
    assert 0 < velocity[0] < 0.2
    assert near.plan()[0].tolist() == [0.0, 0.0]


def test_another_order_breaks_an_attack_off_before_its_first_hit(tmp_path: Path) -> None:
    fight = duel(tmp_path, [("stalker", 10, 10)], [("dummy", 14, 10)])
    fight.order([FIRST_ATTACK])
    fight.tick()
    assert fight.winding_up(0)
    assert fight.plan()[0].tolist() == [0.0, 0.0], "it stands while it aims"
    fight.order([FIRST_ATTACK])
    assert fight.winding_up(0), "the same order again changes nothing"
    fight.order([STOP])
    assert fight.fight.real[0, 0, READY] == 0.0
    assert sum(fight.tick()[0, 1] for _ in range(20)) == 0.0
    fight.order([FIRST_ATTACK])
    assert [fight.tick()[0, 1] for _ in range(4)] == [0, 0, 0, 10]


def test_who_dies_in_a_tick_still_strikes_in_it(tmp_path: Path) -> None:
    """Both teams lose their last unit at once: the end, and no success."""
    weak = load_map(write_map(tmp_path, [("marine", 1, 1)], [FAR])).types["marine"]
    frail = {"frail": weak.model_dump(mode="json") | {"health": 6.0}}
    path = write_map(tmp_path, [("frail", 10, 10)], [("frail", 14, 10)], unit_types=frail)
    env = make_env(path, 1)
    env.reset(np.array([0]), 0, np.array([0]))
    result = env.step(np.array([[FIRST_ATTACK]], dtype=np.int32))
    assert result.terminated[0]
    assert not result.success[0]
    assert not result.truncated[0]
    assert env.state[0, : env.spec.state_size - env.spec.n_actions].tolist() == [0.0] * 7
    # 6 damage and a kill of 6 + 10 + 200.
    assert result.reward[0] == pytest.approx(20 * 16 / 216)


def test_cooldown_in_the_state(tmp_path: Path) -> None:
    env = make_env(write_map(tmp_path, [("marine", 10, 10)], [("dummy", 14, 10)]), 1)
    env.reset(np.array([0]), 0, np.array([0]))
    assert env.state[0, STATE_COOLDOWN] == 0.0
    env.step(np.array([[FIRST_ATTACK]], dtype=np.int32))
    # It fired in the first of eight ticks.
    left_s = env.state[0, STATE_COOLDOWN] * (0.8608 + 0.125)
    assert 0.8608 - 0.0625 <= left_s + 7 * TICK_S <= 0.8608 + 0.125
    assert env.hits[0].tolist() == [[0.0, 6.0], [0.0, 0.0]]
    env.reset(np.array([0]), 0, np.array([1]))
    assert not env.hits.any()


def test_opponents_acquire_the_nearest_within_five_metres(tmp_path: Path) -> None:
    zealot = ("zealot", 20.0, 16.0)
    edge = 5 + 0.375 + 0.5
    robots: list[Placed] = [("marine", 20 - edge - 0.01, 16), ("marine", 20, 16 + edge + 0.01)]
    fight = duel(tmp_path, robots, [zealot])
    velocity = fight.plan()[1 + 1]
    assert fight.targets() == [-1]
    # On its way to the middle of the robots' starts.
    goal = fight.bodies[0, :2, :2].mean(axis=0) - fight.bodies[0, 2, :2]
    np.testing.assert_allclose(velocity, 2.25 * goal / np.linalg.norm(goal), atol=1e-9)
    fight.bodies[0, 1, 1] -= 0.02
    fight.plan()
    assert fight.targets() == [1]
    fight.bodies[0, 0, 0] = 18.0
    fight.plan()
    assert fight.targets() == [1], "it keeps its target though another is nearer now"


def test_stalkers_acquire_within_their_reach(tmp_path: Path) -> None:
    fight = duel(tmp_path, [("marine", 10, 16)], [("stalker", 10 + 6 + 0.375 + 0.62, 16)])
    fight.plan()
    assert fight.targets() == [0]


def test_opponents_help_a_neighbour_that_is_hit(tmp_path: Path) -> None:
    zealots: list[Placed] = [("zealot", 18, 16), ("zealot", 21.9, 16), ("zealot", 26, 16)]
    fight = duel(tmp_path, [("marine", 10, 16)], zealots)
    fight.plan()
    assert fight.targets() == [-1, -1, -1]
    fight.fight.whole[0, 1, HITTER] = 0
    fight.plan()
    assert fight.targets() == [0, 0, -1]


def test_opponents_give_up(tmp_path: Path) -> None:
    fight = duel(tmp_path, [("marine", 5, 16), ("marine", 5, 20)], [("zealot", 9, 16)])
    fight.plan()
    assert fight.targets() == [0]
    fight.bodies[0, 0, 0] = 5 + 21 + 4 + 0.9
    fight.bodies[0, 1, :2] = 9, 1
    fight.plan()
    assert fight.targets() == [-1], "beyond the leash"
    fight.bodies[0, 0, :2] = 12, 16
    fight.plan()
    assert fight.targets() == [0]
    fight.bodies[0, 1, :2] = 9, 14
    for _ in range(16):
        assert fight.targets() == [0]
        fight.plan()
    fight.plan()
    assert fight.targets() == [1], "out of reach for four seconds, and another is nearer"
    assert fight.fight.real[0, 2, CHASE] == 0.0
