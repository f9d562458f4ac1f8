"""Compiled: what every unit is told and how fast it wants to go, once per phase.

Before the physics of a phase each unit gets a velocity: to the point it was ordered to, or
towards its target until that is within reach. Whoever has something in the way goes around it, on
one side until the way is free. brake.py then keeps them from running into each other.

Shapes and columns as in tables.py.
"""

from __future__ import annotations

import numpy as np

from sim_pkg.compiled import entry, helper
from sim_pkg.scenarios.skirmish.layout import FIRST_ATTACK, MOVE_M, STOP
from sim_pkg.scenarios.skirmish.tables import (
    ALIVE,
    ATTACK,
    BODY_RADIUS_M,
    CHASE,
    GO,
    HALT,
    HITTER,
    LAST_ACTION,
    NEXT_HIT,
    OLD_X,
    OLD_Y,
    ORDER,
    POINT_X,
    POINT_Y,
    READY,
    SIDE,
    SPEED_MPS,
    TARGET,
)

# North, south, east, west.
WAYS = np.array([(0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0)])

SLACK_M = 0.02  # a chaser aims this far inside its reach
WATCH_M = 0.35  # what is nearer than this, edge to edge, can be in the way
AHEAD = 0.5  # cosine of the angle within which it is
GONE_M = 1e9  # where the dead are: in nobody's way
SAME_PACE = 0.8  # what goes the same way at this share of one's speed is not in the way


@entry
def take_orders(running, actions, bodies, real, whole):  # type: ignore[no-untyped-def]
    """The robots' actions (B, n) as orders. An attack that has not hit yet is broken off by any
    other order, and may start again at once."""
    n = actions.shape[1]
    for b in range(actions.shape[0]):
        if not running[b]:
            continue
        for i in range(n):
            action = actions[b, i]
            unit = whole[b, i]
            unit[LAST_ACTION] = action
            if not unit[ALIVE]:
                continue
            target = -1
            if action == STOP:
                unit[ORDER] = HALT
            elif action < FIRST_ATTACK:
                unit[ORDER] = GO
                way = WAYS[action - STOP - 1]
                real[b, i, POINT_X] = bodies[b, i, 0] + MOVE_M * way[0]
                real[b, i, POINT_Y] = bodies[b, i, 1] + MOVE_M * way[1]
            else:
                unit[ORDER] = ATTACK
                target = n + action - FIRST_ATTACK
            if target != unit[TARGET] and unit[NEXT_HIT] == 0:
                unit[NEXT_HIT] = -1
                real[b, i, READY] = 0.0
            unit[TARGET] = target


@entry
def drive(  # type: ignore[no-untyped-def]
    running, n, phase_s, bodies, units, reach, acquire, leash, habits, goal, real, whole, commands
):
    """The opponents choose their targets; then everyone's velocity for the next phase.

    habits: help_m, patience_s.
    """
    d = units.shape[0]
    now = np.empty((d, 5))  # x, y, vx, vy, radius
    for b in range(bodies.shape[0]):
        if not running[b]:
            continue
        for i in range(d):
            for k in range(4):
                now[i, k] = bodies[b, i, k]
            now[i, 4] = units[i, BODY_RADIUS_M]
            real[b, i, OLD_X] = now[i, 0]
            real[b, i, OLD_Y] = now[i, 1]
            if not whole[b, i, ALIVE]:
                now[i, 0] = GONE_M
        for j in range(n, d):
            if whole[b, j, ALIVE]:
                _choose_target(
                    b, n, j, phase_s, now, reach, acquire, leash, habits, goal, real, whole
                )
        for j in range(n, d):
            whole[b, j, HITTER] = -1
        for i in range(d):
            vx, vy = _wish(b, i, phase_s, now, units, reach, real, whole)
            commands[b, i, 0] = vx
            commands[b, i, 1] = vy


@helper
def _choose_target(  # type: ignore[no-untyped-def]
    b, n, j, phase_s, now, reach, acquire, leash, habits, goal, real, whole
):
    """Attack-move: opponent j keeps its target while it can, else looks for one."""
    help_m, patience_s = habits
    target = whole[b, j, TARGET]
    if target >= 0:
        distance = _distance(now, j, target)
        within = distance <= reach[j, target]
        real[b, j, CHASE] = 0.0 if within else real[b, j, CHASE] + phase_s
        if distance > leash[j, target]:
            target = -1
    if target < 0 or real[b, j, CHASE] > patience_s:
        found = _look_around(b, n, j, now, acquire, help_m, whole)
        if found >= 0:
            target = found
        real[b, j, CHASE] = 0.0
    whole[b, j, TARGET] = target
    if target >= 0:
        whole[b, j, ORDER] = ATTACK
    else:
        whole[b, j, ORDER] = GO
        real[b, j, POINT_X] = goal[0]
        real[b, j, POINT_Y] = goal[1]


@helper
def _look_around(b, n, j, now, acquire, help_m, whole):  # type: ignore[no-untyped-def]
    """The nearest robot within j's range, else one that hit j or a neighbour of j; -1: none."""
    best, nearest = np.inf, -1
    for i in range(n):
        if whole[b, i, ALIVE]:
            distance = _distance(now, i, j)
            if distance <= acquire[j, i] and distance < best:
                best, nearest = distance, i
    if nearest >= 0:
        return nearest
    best = np.inf
    for k in range(n, whole.shape[1]):
        hitter = whole[b, k, HITTER]
        if hitter >= 0 and whole[b, hitter, ALIVE]:
            distance = _distance(now, j, k)
            if distance <= help_m and distance < best:
                best, nearest = distance, hitter
    return nearest


@helper
def _wish(b, i, phase_s, now, units, reach, real, whole):  # type: ignore[no-untyped-def]
    """The velocity with which unit i would follow its order if it were alone but for detours."""
    order = whole[b, i, ORDER]
    if not whole[b, i, ALIVE] or order == HALT or whole[b, i, NEXT_HIT] == 0:
        return 0.0, 0.0
    target = -1
    if order == GO:
        dx, dy = real[b, i, POINT_X] - now[i, 0], real[b, i, POINT_Y] - now[i, 1]
    else:
        target = whole[b, i, TARGET]
        dx, dy = now[target, 0] - now[i, 0], now[target, 1] - now[i, 1]
    distance = np.sqrt(dx * dx + dy * dy)
    if distance < 1e-6:
        return 0.0, 0.0
    dx /= distance
    dy /= distance
    way = distance
    if target >= 0:
        # What the target runs away in this phase has to be caught up too.
        away = now[target, 2] * dx + now[target, 3] * dy
        way = distance - reach[i, target] + max(away, 0.0) * phase_s
        if way <= 0.0:
            whole[b, i, SIDE] = 0
            return 0.0, 0.0
        way += SLACK_M
    speed = min(units[i, SPEED_MPS], way / phase_s)
    dx, dy = _around(b, i, target, dx, dy, speed, now, whole)
    return speed * dx, speed * dy


@helper
def _around(b, i, target, dx, dy, speed, now, whole):  # type: ignore[no-untyped-def]
    """The direction (dx, dy), or along the edge of the unit that is in the way."""
    most, blocked_x, blocked_y = AHEAD, 0.0, 0.0
    watch = now[i, 4] + WATCH_M
    for k in range(now.shape[0]):
        x, y = now[k, 0] - now[i, 0], now[k, 1] - now[i, 1]
        near = watch + now[k, 4]
        square = x * x + y * y
        if square > near * near or square < 1e-12 or k == target:
            continue
        distance = np.sqrt(square)
        ahead = (x * dx + y * dy) / distance
        pace = now[k, 2] * dx + now[k, 3] * dy
        if ahead > most and pace < SAME_PACE * speed:
            most, blocked_x, blocked_y = ahead, x / distance, y / distance
    if most == AHEAD:
        whole[b, i, SIDE] = 0
        return dx, dy
    if whole[b, i, SIDE] == 0:
        # The side on which less of the way is blocked; straight ahead, every other unit left.
        cross = dx * blocked_y - dy * blocked_x
        if abs(cross) > 1e-6:
            whole[b, i, SIDE] = 1 if cross < 0.0 else -1
        else:
            whole[b, i, SIDE] = 1 if i % 2 == 0 else -1
    side = whole[b, i, SIDE]
    return -side * blocked_y, side * blocked_x


@helper
def _distance(now, i, k):  # type: ignore[no-untyped-def]
    x, y = now[k, 0] - now[i, 0], now[k, 1] - now[i, 1]
    return np.sqrt(x * x + y * y)
