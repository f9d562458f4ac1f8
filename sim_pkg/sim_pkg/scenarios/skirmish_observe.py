"""Compiled: rewards and ends, and what is seen; laid out as in skirmish_layout.py.

Shapes and columns as in skirmish_tables.py.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sim_pkg.scenarios.skirmish_layout import (
    ATTACK_M,
    FIRST_ATTACK,
    MOVE_M,
    NO_OP,
    NORTH,
    SIGHT_M,
    STOP,
)
from sim_pkg.scenarios.skirmish_orders import WAYS
from sim_pkg.scenarios.skirmish_tables import (
    ALIVE,
    BODY_RADIUS_M,
    COOLDOWN_S,
    EXTRA_S,
    HEALTH,
    LAST_ACTION,
    MAX_HEALTH,
    MAX_SHIELD,
    SHIELD,
    WAIT,
)

REWARD_KILL, REWARD_WIN, REWARD_SUM = 10.0, 200.0, 20.0
ROUNDING_M = 1e-9


@njit(cache=True)
def score(  # type: ignore[no-untyped-def]
    running, n, limit, full, real, whole, steps, standing, reward, terminated, success
):
    """Reward and end of every arena's step. ``full``: the rewards of a win before scaling."""
    d = whole.shape[1]
    for b in range(whole.shape[0]):
        reward[b] = 0.0
        terminated[b] = False
        success[b] = False
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


@njit(cache=True)
def observe(  # type: ignore[no-untyped-def]
    running, n, shields, bodies, units, types, free, arena_m, real, whole, obs, state, available
):
    """``shields``: whether features for the robots', the opponents' shields exist."""
    for b in range(bodies.shape[0]):
        if not running[b]:
            continue
        _state(n, shields, bodies[b], units, types, arena_m, real[b], whole[b], state[b])
        for i in range(n):
            obs[b, i, :] = 0.0
            available[b, i, :] = False
            if not whole[b, i, ALIVE]:
                available[b, i, NO_OP] = True
                continue
            _free_ways(i, bodies[b], units, free, obs[b, i], available[b, i])
            _look(i, n, shields, bodies[b], units, types, real[b], whole[b], obs[b, i],
                  available[b, i])  # fmt: skip


@njit(cache=True)
def _free_ways(i, bodies, units, free, obs, available):  # type: ignore[no-untyped-def]
    """A move is available if half its way is free of walls, as in SMAC."""
    available[STOP] = True
    radius = units[i, BODY_RADIUS_M] - ROUNDING_M
    for k in range(4):
        x = bodies[i, 0] + WAYS[k, 0] * MOVE_M / 2
        y = bodies[i, 1] + WAYS[k, 1] * MOVE_M / 2
        # A disc that dents a wall may still go along it.
        in_x = k < 2 or free[0] + radius <= x <= free[2] - radius
        in_y = k >= 2 or free[1] + radius <= y <= free[3] - radius
        if in_x and in_y:
            available[NORTH + k] = True
            obs[k] = 1.0


@njit(cache=True)
def _look(i, n, shields, bodies, units, types, real, whole, obs, available):  # type: ignore[no-untyped-def]
    """Opponents, allies and oneself, from column 4 on; and which attacks are available."""
    at = 4
    for k in range(n, whole.shape[0] + n):
        # Opponents first, then the robots.
        j = k if k < whole.shape[0] else k - whole.shape[0]
        if j == i:
            continue
        shield = shields[0] if j < n else shields[1]
        if whole[j, ALIVE]:
            x, y = bodies[j, 0] - bodies[i, 0], bodies[j, 1] - bodies[i, 1]
            distance = np.sqrt(x * x + y * y)
            if distance <= SIGHT_M:
                if j < n:
                    obs[at] = 1.0
                elif distance <= ATTACK_M:
                    obs[at] = 1.0
                    available[FIRST_ATTACK + j - n] = True
                obs[at + 1] = distance / SIGHT_M
                obs[at + 2] = x / SIGHT_M
                obs[at + 3] = y / SIGHT_M
                _body(j, shield, units, types, real, obs, at + 4, at + 4 + 1)
        at += 5 + shield + types.shape[1]
    _body(i, shields[0], units, types, real, obs, at, at + 1)


@njit(cache=True)
def _body(j, shield, units, types, real, out, at, more_at):  # type: ignore[no-untyped-def]
    """Health at ``at``; shield, where the layout has one, and type bits from ``more_at`` on."""
    out[at] = real[j, HEALTH] / units[j, MAX_HEALTH]
    if shield:
        if units[j, MAX_SHIELD] > 0.0:
            out[more_at] = real[j, SHIELD] / units[j, MAX_SHIELD]
        more_at += 1
    for k in range(types.shape[1]):
        out[more_at + k] = types[j, k]


@njit(cache=True)
def _state(n, shields, bodies, units, types, arena_m, real, whole, state):  # type: ignore[no-untyped-def]
    state[:] = 0.0
    at = 0
    for j in range(whole.shape[0]):
        shield = shields[0] if j < n else shields[1]
        place = at + 2 if j < n else at + 1
        if whole[j, ALIVE]:
            if j < n:
                state[at + 1] = real[j, WAIT] / (units[j, COOLDOWN_S] + EXTRA_S[1])
            state[place] = (bodies[j, 0] - arena_m[0] / 2) / arena_m[0]
            state[place + 1] = (bodies[j, 1] - arena_m[1] / 2) / arena_m[1]
            _body(j, shield, units, types, real, state, at, place + 2)
        at = place + 2 + shield + types.shape[1]
    actions = (state.shape[0] - at) // n
    for i in range(n):
        if whole[i, LAST_ACTION] >= 0:
            state[at + i * actions + whole[i, LAST_ACTION]] = 1.0
