"""Compiled: rewards and ends, and what is seen; laid out as in layout.py.

Shapes and columns as in tables.py.
"""

from __future__ import annotations

import numpy as np

from sim_pkg.compiled import entry, helper
from sim_pkg.scenarios.skirmish.layout import (
    ATTACK_M,
    FIRST_ATTACK,
    MOVE_M,
    NO_OP,
    NORTH,
    SIGHT_M,
    STOP,
)
from sim_pkg.scenarios.skirmish.orders import WAYS
from sim_pkg.scenarios.skirmish.tables import (
    ALIVE,
    BODY_RADIUS_M,
    COOLDOWN_S,
    EXTRA_S,
    HEALTH,
    LAST_ACTION,
    MAX_HEALTH,
    MAX_SHIELD,
    READY,
    SHIELD,
)

REWARD_KILL, REWARD_WIN, REWARD_SUM = 10.0, 200.0, 20.0
ROUNDING_M = 1e-9


@entry
def score(  # type: ignore[no-untyped-def]
    running, n, limit, full, real, whole, steps, standing, reward, terminated, success
):
    """Reward and end of every arena's step. ``full``: the rewards of a win before scaling."""
    d = whole.shape[1]
    for b in range(whole.shape[0]):
        if not running[b]:
            continue
        steps[b] += 1
        left, living = 0.0, 0
        for j in range(n, d):
            left += real[b, j, HEALTH] + real[b, j, SHIELD]
            living += whole[b, j, ALIVE]
        robots = 0
        for i in range(n):
            robots += whole[b, i, ALIVE]
        gain = standing[b, 0] - left + REWARD_KILL * (standing[b, 1] - living)
        standing[b, 0] = left
        standing[b, 1] = living
        success[b] = living == 0 and robots > 0
        if success[b]:
            gain += REWARD_WIN
        reward[b] = gain * REWARD_SUM / full
        terminated[b] = living == 0 or robots == 0 or steps[b] >= limit


@entry
def observe(  # type: ignore[no-untyped-def]
    running, n, bodies, units, real, whole, clock_s, shields, types, free, arena_m, obs, state,
    available,
):  # fmt: skip
    """``shields``: whether features for the robots', the opponents' shields exist."""
    d = units.shape[0]
    now = np.empty((d, 4))  # x, y, health, shield as a share of the full one
    for b in range(bodies.shape[0]):
        if not running[b]:
            continue
        for i in range(d):
            now[i, 0] = bodies[b, i, 0]
            now[i, 1] = bodies[b, i, 1]
            now[i, 2] = real[b, i, HEALTH] / units[i, MAX_HEALTH]
            most = units[i, MAX_SHIELD]
            now[i, 3] = real[b, i, SHIELD] / most if most > 0.0 else 0.0
        _state(b, n, shields, now, units, types, arena_m, clock_s[b], real, whole, state)
        for i in range(n):
            for k in range(obs.shape[2]):
                obs[b, i, k] = 0.0
            for k in range(available.shape[2]):
                available[b, i, k] = False
            if whole[b, i, ALIVE]:
                _free_ways(b, i, now, units, free, obs, available)
                _look(b, i, n, shields, now, types, whole, obs, available)
            else:
                available[b, i, NO_OP] = True


@helper
def _free_ways(b, i, now, units, free, obs, available):  # type: ignore[no-untyped-def]
    """A move is available if half its way is free of walls, as in SMAC."""
    available[b, i, STOP] = True
    radius = units[i, BODY_RADIUS_M] - ROUNDING_M
    for k in range(4):
        # A disc that touches a wall may still go along it.
        axis = 1 if k < 2 else 0
        place = now[i, axis] + WAYS[k, axis] * MOVE_M / 2
        if free[axis] + radius <= place <= free[axis + 2] - radius:
            available[b, i, NORTH + k] = True
            obs[b, i, k] = 1.0


@helper
def _look(b, i, n, shields, now, types, whole, obs, available):  # type: ignore[no-untyped-def]
    """Opponents, allies and oneself, from column 4 on; and which attacks are available."""
    at = 4
    d = whole.shape[1]
    for k in range(n, d + n):
        # Opponents first, then the robots.
        j = k if k < d else k - d
        if j == i:
            continue
        shield = shields[0] if j < n else shields[1]
        x, y = now[j, 0] - now[i, 0], now[j, 1] - now[i, 1]
        square = x * x + y * y
        if square <= SIGHT_M * SIGHT_M and whole[b, j, ALIVE]:
            distance = np.sqrt(square)
            if j < n:
                obs[b, i, at] = 1.0
            elif distance <= ATTACK_M:
                obs[b, i, at] = 1.0
                available[b, i, FIRST_ATTACK + j - n] = True
            obs[b, i, at + 1] = distance * (1.0 / SIGHT_M)
            obs[b, i, at + 2] = x * (1.0 / SIGHT_M)
            obs[b, i, at + 3] = y * (1.0 / SIGHT_M)
            obs[b, i, at + 4] = now[j, 2]
            if shield:
                obs[b, i, at + 5] = now[j, 3]
            for t in range(types.shape[1]):
                obs[b, i, at + 5 + shield + t] = types[j, t]
        at += 5 + shield + types.shape[1]
    obs[b, i, at] = now[i, 2]
    if shields[0]:
        obs[b, i, at + 1] = now[i, 3]
    for t in range(types.shape[1]):
        obs[b, i, at + 1 + shields[0] + t] = types[i, t]


@helper
def _state(b, n, shields, now, units, types, arena_m, clock_s, real, whole, state):  # type: ignore[no-untyped-def]
    for k in range(state.shape[1]):
        state[b, k] = 0.0
    at = 0
    for j in range(whole.shape[1]):
        shield = shields[0] if j < n else shields[1]
        place = at + 2 if j < n else at + 1
        if whole[b, j, ALIVE]:
            state[b, at] = now[j, 2]
            if j < n:
                wait_s = max(real[b, j, READY] - clock_s, 0.0)
                state[b, at + 1] = wait_s / (units[j, COOLDOWN_S] + EXTRA_S[1])
            for axis in range(2):
                state[b, place + axis] = now[j, axis] / arena_m[axis] - 0.5
            if shield:
                state[b, place + 2] = now[j, 3]
            for t in range(types.shape[1]):
                state[b, place + 2 + shield + t] = types[j, t]
        at = place + 2 + shield + types.shape[1]
    actions = (state.shape[1] - at) // n
    for i in range(n):
        if whole[b, i, LAST_ACTION] >= 0:
            state[b, at + i * actions + whole[b, i, LAST_ACTION]] = 1.0
