"""Compiled: nobody drives into anybody, or into a wall.

Chipmunk notices two discs only when they overlap already, up to a substep's way deep (0.3 m at
2.3 m/s). So, as in engines with speculative contacts (Bullet, Box2D), velocities are limited
before the physics: in one phase no pair comes closer than touching. The units brake, as a robot
with a proximity sensor does, and are not pushed: who stands stays.

Shapes and columns as in skirmish_tables.py.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sim_pkg.scenarios.skirmish_tables import ALIVE, BODY_RADIUS_M, SPEED_MPS

SLIDE_PASSES, SHRINK_PASSES = 3, 8


@njit(cache=True)
def brake(running, phase_s, bodies, units, free, whole, commands):  # type: ignore[no-untyped-def]
    """Limits the velocities of everyone for a phase, in place."""
    for b in range(bodies.shape[0]):
        if running[b]:
            _brake_arena(phase_s, bodies[b], units, free, whole[b], commands[b])


@njit(cache=True)
def _brake_arena(phase_s, bodies, units, free, whole, commands):  # type: ignore[no-untyped-def]
    """Slows approaching pairs so that, if they keep their velocities, they just touch.

    First along the line between them, so that they slide past each other. Where that settles one
    pair at the expense of another, whole velocities shrink, which can only end well.
    """
    d = units.shape[0]
    for turn in range(SLIDE_PASSES + SHRINK_PASSES):
        changed = False
        _brake_at_walls(phase_s, bodies, units, free, commands)
        for i in range(d):
            if not whole[i, ALIVE]:
                continue
            for k in range(i + 1, d):
                if not whole[k, ALIVE]:
                    continue
                slide = turn < SLIDE_PASSES
                if _brake_pair(i, k, slide, phase_s, bodies, units, commands):
                    changed = True
        if not changed:
            return
    _brake_at_walls(phase_s, bodies, units, free, commands)


@njit(cache=True)
def _brake_pair(i, k, slide, phase_s, bodies, units, commands):  # type: ignore[no-untyped-def]
    """Whether i and k had to brake, in proportion to what each contributes to the approach."""
    x, y = bodies[k, 0] - bodies[i, 0], bodies[k, 1] - bodies[i, 1]
    touch = units[i, BODY_RADIUS_M] + units[k, BODY_RADIUS_M]
    far = touch + (units[i, SPEED_MPS] + units[k, SPEED_MPS]) * phase_s
    square = x * x + y * y
    if square > far * far or square < 1e-12:
        return False
    vx, vy = commands[k, 0] - commands[i, 0], commands[k, 1] - commands[i, 1]
    closing = -(vx * x + vy * y)
    if closing <= 1e-12:
        return False
    distance = np.sqrt(square)
    if distance > touch:
        when = min(phase_s, closing / (vx * vx + vy * vy))
        nx, ny = x + when * vx, y + when * vy
        if nx * nx + ny * ny >= touch * touch:
            return False
    x /= distance
    y /= distance
    mine = commands[i, 0] * x + commands[i, 1] * y
    theirs = -(commands[k, 0] * x + commands[k, 1] * y)
    excess = mine + theirs - max(distance - touch, 0.0) / phase_s
    if excess <= 1e-9:
        return False
    share = excess / (max(mine, 0.0) + max(theirs, 0.0))
    if mine > 0.0:
        _slow(i, slide, share, mine * x, mine * y, commands)
    if theirs > 0.0:
        _slow(k, slide, share, -theirs * x, -theirs * y, commands)
    return True


@njit(cache=True)
def _slow(i, slide, share, x, y, commands):  # type: ignore[no-untyped-def]
    """Takes ``share`` off the part (x, y) of i's velocity, or off all of it."""
    if slide:
        commands[i, 0] -= share * x
        commands[i, 1] -= share * y
    else:
        commands[i, 0] *= 1.0 - share
        commands[i, 1] *= 1.0 - share


@njit(cache=True)
def _brake_at_walls(phase_s, bodies, units, free, commands):  # type: ignore[no-untyped-def]
    for i in range(units.shape[0]):
        radius = units[i, BODY_RADIUS_M]
        for axis in range(2):
            low = min(free[axis] + radius - bodies[i, axis], 0.0) / phase_s
            high = max(free[axis + 2] - radius - bodies[i, axis], 0.0) / phase_s
            commands[i, axis] = min(max(commands[i, axis], low), high)
