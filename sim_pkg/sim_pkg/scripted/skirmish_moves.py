"""Compiled: what a robot of a skirmish reads from its observation, and the moves it picks.

Shapes: m opponents. A robot's view of them is (m, VIEW_COLUMNS), in metres, relative to itself.
"""

from __future__ import annotations

import numpy as np

from sim_pkg.compiled import entry
from sim_pkg.scenarios.skirmish.layout import (
    ATTACKABLE,
    DISTANCE,
    DX,
    DY,
    FIRST_ATTACK,
    HEALTH,
    NORTH,
    SIGHT_M,
    STOP,
)
from sim_pkg.scenarios.skirmish.orders import WAYS

# SEEN: 1 or 0. CAN: an attack may be ordered. LEFT: health and shield together.
SEEN, CAN, X, Y, AWAY, LEFT, VIEW_COLUMNS = range(7)

LOOK_S = 3.0  # how far ahead a fleeing robot looks
KEEP_M = 0.6  # of distance that going on in the same direction is worth: turns cost way
TURN_M = 1.0  # ... and that going around the opponents on one side is: out of corners


@entry
def look(row, first, width, shielded, full, available, view):  # type: ignore[no-untyped-def]
    """Fills ``view`` from an observation row. full: (m, 2) largest health and shield."""
    for j in range(view.shape[0]):
        part = row[first + j * width : first + (j + 1) * width]
        view[j, SEEN] = part[DISTANCE] > 0.0
        view[j, CAN] = part[ATTACKABLE] > 0.0 and available[FIRST_ATTACK + j]
        view[j, X] = part[DX] * SIGHT_M
        view[j, Y] = part[DY] * SIGHT_M
        view[j, AWAY] = part[DISTANCE] * SIGHT_M
        view[j, LEFT] = part[HEALTH] * full[j, 0]
        if shielded:
            view[j, LEFT] += part[HEALTH + 1] * full[j, 1]


@entry
def least(view, which, of):  # type: ignore[no-untyped-def]
    """The opponent with the smallest column ``of`` among those with column ``which``; -1: none."""
    best, found = np.inf, -1
    for j in range(view.shape[0]):
        if view[j, which] > 0.0 and view[j, of] < best:
            best, found = view[j, of], j
    return found


@entry
def pick(view, reach):  # type: ignore[no-untyped-def]
    """The weakest opponent within ``reach`` (m,), else the nearest that may be attacked; -1: none.

    An attack on one that is farther away is a walk.
    """
    best, found = np.inf, -1
    for j in range(view.shape[0]):
        if view[j, CAN] > 0.0 and view[j, AWAY] <= reach[j] and view[j, LEFT] < best:
            best, found = view[j, LEFT], j
    return found if found >= 0 else least(view, CAN, AWAY)


@entry
def towards(x, y, available):  # type: ignore[no-untyped-def]
    """The available move that leads most towards (x, y); stop if all lead away."""
    best, action = 0.0, STOP
    for k in range(4):
        gain = WAYS[k, 0] * x + WAYS[k, 1] * y
        if available[NORTH + k] and gain > best:
            best, action = gain, NORTH + k
    return action


@entry
def advance(view, available):  # type: ignore[no-untyped-def]
    """Towards the nearest opponent in sight; without one, east, where they come from."""
    near = least(view, SEEN, AWAY)
    if near < 0:
        return towards(1.0, 0.0, available)
    return towards(view[near, X], view[near, Y], available)


@entry
def flee(view, threats, own_mps, their_mps, available, last):  # type: ignore[no-untyped-def]
    """The move that keeps the nearest of ``threats`` (m,) farthest away, if all follow.

    A robot has four directions: going diagonally is slow, so it goes on as it did (``last``)
    where that is about as good. Where a wall stops it, it turns left.
    """
    best, action = -np.inf, STOP
    mx, my = 0.0, 0.0
    for j in range(view.shape[0]):
        if threats[j]:
            mx += view[j, X] / view[j, AWAY]
            my += view[j, Y] / view[j, AWAY]
    for k in range(4):
        if not available[NORTH + k]:
            continue
        worst = np.inf
        for j in range(view.shape[0]):
            if threats[j]:
                x = view[j, X] - own_mps * LOOK_S * WAYS[k, 0]
                y = view[j, Y] - own_mps * LOOK_S * WAYS[k, 1]
                worst = min(worst, np.sqrt(x * x + y * y) - their_mps[j] * LOOK_S)
        if NORTH + k == last:
            worst += KEEP_M
        if mx * WAYS[k, 1] - my * WAYS[k, 0] > 0.0:
            worst += TURN_M
        if worst > best:
            best, action = worst, NORTH + k
    return action
