"""Compiled: cooldowns, hits, shields and deaths, in StarCraft II's ticks of 1/16 s.

A phase's physics comes first; its ticks then see each unit on the straight line from where it was
to where it is. All units act on the same instant: who dies in a tick still strikes in it, so both
teams can lose their last unit at once. Shapes and columns as in skirmish_tables.py.
"""

from __future__ import annotations

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
    deaths = False
    for b in range(bodies.shape[0]):
        if not running[b]:
            continue
        for tick in range(ticks):
            share = (tick + 1) / ticks
            hit = False
            for i in range(units.shape[0]):
                if whole[b, i, ALIVE]:
                    _recover(b, i, tick_s, units, real)
            for i in range(units.shape[0]):
                if whole[b, i, ALIVE]:
                    _attack(b, i, share, tick_s, bodies, units, reach, extras_s, real, whole)
                    if whole[b, i, NEXT_HIT] >= 0:
                        hit |= _strike(b, i, units, hits_s, damage, real, whole, hits)
            if hit and _bury(b, real, whole):
                deaths = True
    return deaths


@njit(cache=True)
def _recover(b, i, tick_s, units, real):  # type: ignore[no-untyped-def]
    real[b, i, WAIT] = max(real[b, i, WAIT] - tick_s, 0.0)
    real[b, i, QUIET] += tick_s
    most = units[i, MAX_SHIELD]
    if real[b, i, SHIELD] < most and real[b, i, QUIET] > units[i, SHIELD_AFTER_S] + ROUNDING_S:
        real[b, i, SHIELD] = min(real[b, i, SHIELD] + units[i, SHIELD_PER_S] * tick_s, most)


@njit(cache=True)
def _attack(  # type: ignore[no-untyped-def]
    b, i, share, tick_s, bodies, units, reach, extras_s, real, whole
):
    """Unit i goes on with its attack, or starts one if it may and its target is within reach,
    ``share`` of the phase on."""
    if whole[b, i, NEXT_HIT] >= 0:
        real[b, i, SINCE] += tick_s
        return
    target = whole[b, i, TARGET]
    if whole[b, i, ORDER] != ATTACK or real[b, i, WAIT] > ROUNDING_S or not whole[b, target, ALIVE]:
        return
    square = 0.0
    for axis in range(2):
        old = real[b, target, OLD_X + axis] - real[b, i, OLD_X + axis]
        new = bodies[b, target, axis] - bodies[b, i, axis]
        square += (old + share * (new - old)) ** 2
    if square <= reach[i, target] * reach[i, target]:
        whole[b, i, VICTIM] = target
        whole[b, i, NEXT_HIT] = 0
        real[b, i, SINCE] = 0.0
        count = whole[b, i, ATTACKS]
        real[b, i, WAIT] = units[i, COOLDOWN_S] + extras_s[b, i, count % extras_s.shape[2]]
        whole[b, i, ATTACKS] = count + 1


@njit(cache=True)
def _strike(b, i, units, hits_s, damage, real, whole, hits):  # type: ignore[no-untyped-def]
    """Whether any hit of the present attack landed."""
    landed = False
    victim = whole[b, i, VICTIM]
    while (
        whole[b, i, NEXT_HIT] >= 0
        and real[b, i, SINCE] >= hits_s[i, whole[b, i, NEXT_HIT]] - ROUNDING_S
    ):
        hits[b, i, victim] += _hit(b, victim, damage[i, victim], units, real)
        whole[b, victim, HITTER] = i
        whole[b, i, NEXT_HIT] += 1
        if whole[b, i, NEXT_HIT] >= units[i, N_HITS]:
            whole[b, i, NEXT_HIT] = -1
        landed = True
    return landed


@njit(cache=True)
def _hit(b, victim, damage, units, real):  # type: ignore[no-untyped-def]
    """What the victim loses: shield first, and what is left of the hit, less armour, health."""
    on_shield = min(damage, real[b, victim, SHIELD])
    real[b, victim, SHIELD] -= on_shield
    real[b, victim, QUIET] = 0.0
    on_health = damage - on_shield
    if on_health > 0.0:
        on_health = max(on_health - units[victim, ARMOUR], LEAST_DAMAGE)
        on_health = min(on_health, real[b, victim, HEALTH])
        real[b, victim, HEALTH] -= on_health
    return on_shield + on_health


@njit(cache=True)
def _bury(b, real, whole):  # type: ignore[no-untyped-def]
    """Who has no health left is dead; attacks on the dead end, and an order to attack one.

    Whether any died.
    """
    died = False
    for i in range(whole.shape[1]):
        if whole[b, i, ALIVE] and real[b, i, HEALTH] <= 0.0:
            whole[b, i, ALIVE] = 0
            whole[b, i, NEXT_HIT] = whole[b, i, TARGET] = -1
            whole[b, i, ORDER] = HALT
            real[b, i, SHIELD] = 0.0
            died = True
    if not died:
        return False
    for i in range(whole.shape[1]):
        if whole[b, i, NEXT_HIT] >= 0 and not whole[b, whole[b, i, VICTIM], ALIVE]:
            if whole[b, i, NEXT_HIT] == 0:
                real[b, i, WAIT] = 0.0
            whole[b, i, NEXT_HIT] = -1
        if whole[b, i, TARGET] >= 0 and not whole[b, whole[b, i, TARGET], ALIVE]:
            whole[b, i, TARGET] = -1
            whole[b, i, ORDER] = HALT
    return True
