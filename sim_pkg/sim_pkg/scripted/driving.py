"""Driving a heavy robot in 9 actions: what the policies of transport and coverage share."""

from __future__ import annotations

import numpy as np
from numba import njit

# Metres that a robot goes out of its way for each metre by which it would come too near.
AVOID = 4.0


@njit(cache=True)
def drive_to(target, velocity, others, apart_m, directions, speed_mps, accel_mps2, dt_s):  # type: ignore[no-untyped-def]
    """The action after which braking would end nearest to ``target`` and clear of ``others``.

    Looks one control step ahead, with limited acceleration. Positions are relative to the
    robot, in m. target: (2,); velocity: (2,) m/s; others: (k, 2), rows with NaN are not there.
    """
    best, best_cost = 0, np.inf
    for action in range(len(directions)):
        change = speed_mps * directions[action] - velocity
        norm = np.sqrt(change[0] * change[0] + change[1] * change[1])
        limit = accel_mps2 * dt_s
        if norm > limit:
            change *= limit / norm
        after = velocity + change
        braking_s = np.sqrt(after[0] * after[0] + after[1] * after[1]) / (2.0 * accel_mps2)
        end = (velocity + 0.5 * change) * dt_s + after * braking_s
        cost = np.sqrt((end[0] - target[0]) ** 2 + (end[1] - target[1]) ** 2)
        for k in range(len(others)):
            gap = np.sqrt((end[0] - others[k, 0]) ** 2 + (end[1] - others[k, 1]) ** 2)
            if gap < apart_m:
                cost += AVOID * (apart_m - gap)
        if cost < best_cost - 1e-6:
            best, best_cost = action, cost
    return best


@njit(cache=True)
def read_others(row, sight_m, others):  # type: ignore[no-untyped-def]
    """(k, 2) places of the other robots from (seen, dx, dy) triples; NaN where unseen."""
    for k in range(len(others)):
        seen = row[3 * k] > 0.0
        others[k, 0] = row[3 * k + 1] * sight_m if seen else np.nan
        others[k, 1] = row[3 * k + 2] * sight_m if seen else np.nan
