"""Compiled: nobody drives into anybody, or into a wall.

Chipmunk notices two discs only when they overlap already, up to a substep's way deep (0.3 m at
2.3 m/s). So, as in engines with speculative contacts (Bullet, Box2D), velocities are limited
before the physics: in one phase no pair comes closer than touching. The units brake, as a robot
with a proximity sensor does, and are not pushed: who stands stays.

Shapes and columns as in tables.py.
"""

from __future__ import annotations

import numpy as np

from sim_pkg.compiled import entry, helper
from sim_pkg.scenarios.skirmish.tables import ALIVE, BODY_RADIUS_M, SPEED_MPS

SLIDE_PASSES, SHRINK_PASSES = 3, 8

# Of a pair that could meet: i, k, the unit vector from i to k, their distance, that at touching.
FIRST, SECOND, X, Y, DISTANCE, TOUCH, PAIR_COLUMNS = range(7)


@entry
def brake(running, phase_s, bodies, units, free, whole, commands):  # type: ignore[no-untyped-def]
    """Limits the velocities of everyone for a phase, in place."""
    d = units.shape[0]
    pairs = np.empty((d * (d - 1) // 2, PAIR_COLUMNS))
    now = np.empty((d, 4))
    for b in range(bodies.shape[0]):
        if not running[b]:
            continue
        for i in range(d):
            now[i, 0] = bodies[b, i, 0]
            now[i, 1] = bodies[b, i, 1]
            now[i, 2] = commands[b, i, 0]
            now[i, 3] = commands[b, i, 1]
        near = _pair_up(b, phase_s, units, whole, now, pairs)
        _settle(near, phase_s, units, free, now, pairs)
        for i in range(d):
            commands[b, i, 0] = now[i, 2]
            commands[b, i, 1] = now[i, 3]


@helper
def _pair_up(b, phase_s, units, whole, now, pairs):  # type: ignore[no-untyped-def]
    """How many pairs are near enough to meet in this phase."""
    near = 0
    for i in range(units.shape[0]):
        if not whole[b, i, ALIVE]:
            continue
        speed = np.sqrt(now[i, 2] * now[i, 2] + now[i, 3] * now[i, 3])
        for k in range(i + 1, units.shape[0]):
            if not whole[b, k, ALIVE]:
                continue
            x, y = now[k, 0] - now[i, 0], now[k, 1] - now[i, 1]
            square = x * x + y * y
            touch = units[i, BODY_RADIUS_M] + units[k, BODY_RADIUS_M]
            most = touch + (speed + units[k, SPEED_MPS]) * phase_s
            if square > most * most or square < 1e-12:
                continue
            distance = np.sqrt(square)
            pairs[near, FIRST] = i
            pairs[near, SECOND] = k
            pairs[near, X] = x / distance
            pairs[near, Y] = y / distance
            pairs[near, DISTANCE] = distance
            pairs[near, TOUCH] = touch
            near += 1
    return near


@helper
def _settle(near, phase_s, units, free, now, pairs):  # type: ignore[no-untyped-def]
    """Slows approaching pairs so that, if they keep their velocities, they just touch.

    First along the line between them, so that they slide past each other. Where that settles one
    pair at the expense of another, whole velocities shrink, which can only end well.
    """
    for turn in range(SLIDE_PASSES + SHRINK_PASSES):
        _brake_at_walls(phase_s, units, free, now)
        changed = False
        for pair in range(near):
            if _brake_pair(pair, turn < SLIDE_PASSES, phase_s, now, pairs):
                changed = True
        if not changed:
            return
    _brake_at_walls(phase_s, units, free, now)


@helper
def _brake_pair(pair, slide, phase_s, now, pairs):  # type: ignore[no-untyped-def]
    """Whether the two had to brake, in proportion to what each contributes to the approach."""
    i, k = int(pairs[pair, FIRST]), int(pairs[pair, SECOND])
    x, y, distance, touch = (
        pairs[pair, X], pairs[pair, Y], pairs[pair, DISTANCE], pairs[pair, TOUCH],
    )  # fmt: skip
    mine = now[i, 2] * x + now[i, 3] * y
    theirs = -(now[k, 2] * x + now[k, 3] * y)
    excess = mine + theirs - max(distance - touch, 0.0) / phase_s
    if excess <= 1e-9:
        return False
    if distance > touch:
        # Do they pass each other?
        vx, vy = now[k, 2] - now[i, 2], now[k, 3] - now[i, 3]
        when = min(phase_s, distance * (mine + theirs) / (vx * vx + vy * vy))
        nx, ny = distance * x + when * vx, distance * y + when * vy
        if nx * nx + ny * ny >= touch * touch:
            return False
    share = excess / (max(mine, 0.0) + max(theirs, 0.0))
    if mine > 0.0:
        _slow(i, slide, share, mine * x, mine * y, now)
    if theirs > 0.0:
        _slow(k, slide, share, -theirs * x, -theirs * y, now)
    return True


@helper
def _slow(i, slide, share, x, y, now):  # type: ignore[no-untyped-def]
    """Takes ``share`` off the part (x, y) of i's velocity, or off all of it."""
    if slide:
        now[i, 2] -= share * x
        now[i, 3] -= share * y
    else:
        now[i, 2] *= 1.0 - share
        now[i, 3] *= 1.0 - share


@helper
def _brake_at_walls(phase_s, units, free, now):  # type: ignore[no-untyped-def]
    for i in range(units.shape[0]):
        radius = units[i, BODY_RADIUS_M]
        for axis in range(2):
            low = min(free[axis] + radius - now[i, axis], 0.0) / phase_s
            high = max(free[axis + 2] - radius - now[i, axis], 0.0) / phase_s
            now[i, axis + 2] = min(max(now[i, axis + 2], low), high)
