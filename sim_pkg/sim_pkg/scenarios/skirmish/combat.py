"""Compiled: cooldowns, hits, shields and deaths, in StarCraft II's ticks of 1/16 s.

A phase's physics comes first; its ticks then see each unit on the straight line from where it was
to where it is. All units act on the same instant: who dies in a tick still strikes in it, so both
teams can lose their last unit at once.

Shapes and columns as in tables.py.
"""

from __future__ import annotations

import numpy as np

from sim_pkg.compiled import entry, helper
from sim_pkg.scenarios.skirmish.tables import (
    ALIVE,
    ARMOUR,
    ATTACK,
    ATTACKS,
    COOLDOWN_S,
    HALT,
    HEALTH,
    HITTER,
    HURT,
    MAX_SHIELD,
    N_HITS,
    NEXT_HIT,
    OLD_X,
    ORDER,
    READY,
    SHIELD,
    SHIELD_AFTER_S,
    SHIELD_PER_S,
    STARTED,
    TARGET,
    VICTIM,
)

LEAST_DAMAGE = 0.5  # of a hit on health, however thick the armour (StarCraft II)
ROUNDING_S = 1e-9


@entry
def fight(  # type: ignore[no-untyped-def]
    running, ticks, tick_s, bodies, units, hits_s, damage, reach, extras_s, clock_s, real, whole,
    hits,
):  # fmt: skip
    """``ticks`` ticks; ``hits`` (B, d, d) gains the damage that i did to j. Whether any died."""
    deaths = False
    d = units.shape[0]
    fighters = np.empty(d, dtype=np.int64)
    weak = np.empty(d, dtype=np.int64)
    for b in range(bodies.shape[0]):
        if not running[b]:
            continue
        n_fighters, n_weak = _muster(b, units, real, whole, fighters, weak)
        for tick in range(ticks):
            share = (tick + 1) / ticks
            clock_s[b] += tick_s
            hit = False
            for k in range(n_weak):
                _recover(b, weak[k], tick_s, clock_s[b], units, real, whole)
            for k in range(n_fighters):
                i = fighters[k]
                if whole[b, i, ALIVE]:
                    if whole[b, i, NEXT_HIT] < 0:
                        _start(b, i, share, clock_s[b], bodies, units, reach, extras_s, real, whole)
                    if whole[b, i, NEXT_HIT] >= 0:
                        hit |= _strike(b, i, clock_s[b], units, hits_s, damage, real, whole, hits)
            if hit and _bury(b, real, whole):
                deaths = True
    return deaths


@helper
def _muster(b, units, real, whole, fighters, weak):  # type: ignore[no-untyped-def]
    """Lists who can strike in this phase and whose shield can grow; how many of each."""
    n_fighters, n_weak = 0, 0
    for i in range(units.shape[0]):
        if not whole[b, i, ALIVE]:
            continue
        if whole[b, i, ORDER] == ATTACK or whole[b, i, NEXT_HIT] >= 0:
            fighters[n_fighters] = i
            n_fighters += 1
        if real[b, i, SHIELD] < units[i, MAX_SHIELD]:
            weak[n_weak] = i
            n_weak += 1
    return n_fighters, n_weak


@helper
def _recover(b, i, tick_s, clock_s, units, real, whole):  # type: ignore[no-untyped-def]
    quiet_s = clock_s - real[b, i, HURT]
    if quiet_s > units[i, SHIELD_AFTER_S] + ROUNDING_S and whole[b, i, ALIVE]:
        more = real[b, i, SHIELD] + units[i, SHIELD_PER_S] * tick_s
        real[b, i, SHIELD] = min(more, units[i, MAX_SHIELD])


@helper
def _start(b, i, share, clock_s, bodies, units, reach, extras_s, real, whole):  # type: ignore[no-untyped-def]
    """Unit i starts an attack if it may and its target is within reach, ``share`` of the phase
    on."""
    target = whole[b, i, TARGET]
    if whole[b, i, ORDER] != ATTACK or real[b, i, READY] > clock_s + ROUNDING_S:
        return
    square = 0.0
    for axis in range(2):
        old = real[b, target, OLD_X + axis] - real[b, i, OLD_X + axis]
        new = bodies[b, target, axis] - bodies[b, i, axis]
        square += (old + share * (new - old)) ** 2
    if square <= reach[i, target] * reach[i, target] and whole[b, target, ALIVE]:
        whole[b, i, VICTIM] = target
        whole[b, i, NEXT_HIT] = 0
        real[b, i, STARTED] = clock_s
        count = whole[b, i, ATTACKS]
        extra_s = extras_s[b, i, count % extras_s.shape[2]]
        real[b, i, READY] = clock_s + units[i, COOLDOWN_S] + extra_s
        whole[b, i, ATTACKS] = count + 1


@helper
def _strike(b, i, clock_s, units, hits_s, damage, real, whole, hits):  # type: ignore[no-untyped-def]
    """Whether any hit of the present attack landed."""
    landed = False
    victim = whole[b, i, VICTIM]
    since_s = clock_s - real[b, i, STARTED]
    while whole[b, i, NEXT_HIT] >= 0 and since_s >= hits_s[i, whole[b, i, NEXT_HIT]] - ROUNDING_S:
        hits[b, i, victim] += _hit(b, victim, damage[i, victim], clock_s, units, real)
        whole[b, victim, HITTER] = i
        whole[b, i, NEXT_HIT] += 1
        if whole[b, i, NEXT_HIT] >= units[i, N_HITS]:
            whole[b, i, NEXT_HIT] = -1
        landed = True
    return landed


@helper
def _hit(b, victim, damage, clock_s, units, real):  # type: ignore[no-untyped-def]
    """What the victim loses: shield first, and what is left of the hit, less armour, health."""
    on_shield = min(damage, real[b, victim, SHIELD])
    real[b, victim, SHIELD] -= on_shield
    real[b, victim, HURT] = clock_s
    on_health = damage - on_shield
    if on_health > 0.0:
        on_health = max(on_health - units[victim, ARMOUR], LEAST_DAMAGE)
        on_health = min(on_health, real[b, victim, HEALTH])
        real[b, victim, HEALTH] -= on_health
    return on_shield + on_health


@helper
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
                real[b, i, READY] = 0.0
            whole[b, i, NEXT_HIT] = -1
        if whole[b, i, TARGET] >= 0 and not whole[b, whole[b, i, TARGET], ALIVE]:
            whole[b, i, TARGET] = -1
            whole[b, i, ORDER] = HALT
    return True
