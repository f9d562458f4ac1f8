"""Compiled: cooldowns, hits, shields and deaths, in StarCraft II's ticks of 1/16 s.

A phase's physics comes first; its ticks then see each unit on the straight line from where it was
to where it is. All units act on the same instant: who dies in a tick still strikes in it, so both
teams can lose their last unit at once. Shapes and columns as in skirmish_tables.py.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sim_pkg.scenarios.skirmish_tables import (
    ALIVE,
    ARMOUR,
    ATTACK,
    ATTACKS,
    COOLDOWN_S,
    HALT,
    HEALTH,
    HITTER,
    MAX_SHIELD,
    N_HITS,
    NEXT_HIT,
    OLD_X,
    OLD_Y,
    ORDER,
    QUIET,
    SHIELD,
    SHIELD_AFTER_S,
    SHIELD_PER_S,
    SINCE,
    TARGET,
    VICTIM,
    WAIT,
)

LEAST_DAMAGE = 0.5  # of a hit on health, however thick the armour (StarCraft II)
ROUNDING_S = 1e-9


@njit(cache=True)
def fight(  # type: ignore[no-untyped-def]
    running, ticks, tick_s, bodies, units, hits_s, damage, reach, extras_s, real, whole, hits
):
    """``ticks`` ticks; ``hits`` (B, d, d) gains the damage that i did to j. Whether any died."""
    d = units.shape[0]
    deaths = False
    at = np.empty((d, 2))
    for b in range(bodies.shape[0]):
        if not running[b]:
            continue
        for tick in range(ticks):
            share = (tick + 1) / ticks
            for i in range(d):
                at[i, 0] = real[b, i, OLD_X] + share * (bodies[b, i, 0] - real[b, i, OLD_X])
                at[i, 1] = real[b, i, OLD_Y] + share * (bodies[b, i, 1] - real[b, i, OLD_Y])
            for i in range(d):
                if whole[b, i, ALIVE]:
                    _recover(i, tick_s, units, real[b])
            for i in range(d):
                if whole[b, i, ALIVE]:
                    _act(
                        i, tick_s, at, units, hits_s, damage, reach, extras_s[b], real[b],
                        whole[b], hits[b],
                    )  # fmt: skip
            deaths |= _bury(real[b], whole[b])
    return deaths


@njit(cache=True)
def _recover(i, tick_s, units, real):  # type: ignore[no-untyped-def]
    unit = real[i]
    unit[WAIT] = max(unit[WAIT] - tick_s, 0.0)
    unit[QUIET] += tick_s
    if unit[SHIELD] < units[i, MAX_SHIELD] and unit[QUIET] > units[i, SHIELD_AFTER_S] + ROUNDING_S:
        unit[SHIELD] = min(unit[SHIELD] + units[i, SHIELD_PER_S] * tick_s, units[i, MAX_SHIELD])


@njit(cache=True)
def _act(  # type: ignore[no-untyped-def]
    i, tick_s, at, units, hits_s, damage, reach, extras_s, real, whole, hits
):
    """Unit i goes on with its attack, or starts one."""
    unit = whole[i]
    if unit[NEXT_HIT] >= 0:
        real[i, SINCE] += tick_s
    elif unit[ORDER] == ATTACK and real[i, WAIT] <= ROUNDING_S:
        target = unit[TARGET]
        x, y = at[target, 0] - at[i, 0], at[target, 1] - at[i, 1]
        if whole[target, ALIVE] and x * x + y * y <= reach[i, target] ** 2:
            unit[VICTIM] = target
            unit[NEXT_HIT] = 0
            real[i, SINCE] = 0.0
            real[i, WAIT] = units[i, COOLDOWN_S] + extras_s[i, unit[ATTACKS] % extras_s.shape[1]]
            unit[ATTACKS] += 1
    while unit[NEXT_HIT] >= 0 and real[i, SINCE] >= hits_s[i, unit[NEXT_HIT]] - ROUNDING_S:
        victim = unit[VICTIM]
        hits[i, victim] += _hit(victim, damage[i, victim], units, real)
        whole[victim, HITTER] = i
        unit[NEXT_HIT] += 1
        if unit[NEXT_HIT] >= units[i, N_HITS]:
            unit[NEXT_HIT] = -1


@njit(cache=True)
def _hit(victim, damage, units, real):  # type: ignore[no-untyped-def]
    """What the victim loses: shield first, and what is left of the hit, less armour, health."""
    unit = real[victim]
    on_shield = min(damage, unit[SHIELD])
    unit[SHIELD] -= on_shield
    unit[QUIET] = 0.0
    on_health = damage - on_shield
    if on_health > 0.0:
        on_health = min(max(on_health - units[victim, ARMOUR], LEAST_DAMAGE), unit[HEALTH])
        unit[HEALTH] -= on_health
    return on_shield + on_health


@njit(cache=True)
def _bury(real, whole):  # type: ignore[no-untyped-def]
    """Who has no health left is dead; attacks on the dead end, and an order to attack one.

    Whether any died.
    """
    died = False
    for i in range(whole.shape[0]):
        if whole[i, ALIVE] and real[i, HEALTH] <= 0.0:
            whole[i, ALIVE] = 0
            real[i, SHIELD] = 0.0
            died = True
    if not died:
        return False
    for i in range(whole.shape[0]):
        if not whole[i, ALIVE]:
            whole[i, NEXT_HIT] = whole[i, TARGET] = -1
            whole[i, ORDER] = HALT
            continue
        if whole[i, NEXT_HIT] >= 0 and not whole[whole[i, VICTIM], ALIVE]:
            if whole[i, NEXT_HIT] == 0:
                real[i, WAIT] = 0.0
            whole[i, NEXT_HIT] = -1
        if whole[i, TARGET] >= 0 and not whole[whole[i, TARGET], ALIVE]:
            whole[i, TARGET] = -1
            whole[i, ORDER] = HALT
    return True
