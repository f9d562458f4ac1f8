"""Driving a heavy robot in 9 actions: what the policies of transport and coverage share."""

from __future__ import annotations

import numpy as np

from sim_pkg.compiled import entry

# Metres that a robot goes out of its way for each metre by which it would come too near.
AVOID = 4.0


@entry
def drive_to(target, velocity, others, apart_m, directions, speed_mps, accel_mps2, dt_s):  # type: ignore[no-untyped-def]
    """The action after which braking would end nearest to ``target`` and clear of ``others``.

    Looks one control step ahead, with limited acceleration. Positions are relative to the
    robot, in m. target: (x, y); velocity: (vx, vy) in m/s; others: (k, 2), NaN: not there.
    """
    best, best_cost = 0, np.inf
    vx, vy = velocity
    for action in range(len(directions)):
        dx, dy = speed_mps * directions[action, 0] - vx, speed_mps * directions[action, 1] - vy
        change = np.sqrt(dx * dx + dy * dy)
        share = min(1.0, accel_mps2 * dt_s / change) if change > 0.0 else 0.0
        dx, dy = dx * share, dy * share
        braking_s = np.sqrt((vx + dx) ** 2 + (vy + dy) ** 2) / (2.0 * accel_mps2)
        x = (vx + 0.5 * dx) * dt_s + (vx + dx) * braking_s
        y = (vy + 0.5 * dy) * dt_s + (vy + dy) * braking_s
        cost = np.sqrt((x - target[0]) ** 2 + (y - target[1]) ** 2)
        for k in range(len(others)):
            gap = np.sqrt((x - others[k, 0]) ** 2 + (y - others[k, 1]) ** 2)
            if gap < apart_m:
                cost += AVOID * (apart_m - gap)
        if cost < best_cost - 1e-6:
            best, best_cost = action, cost
    return best


@entry
def read_others(row, sight_m, others):  # type: ignore[no-untyped-def]
    """(k, 2) places of the other robots from (seen, dx, dy) triples; NaN where unseen."""
    for k in range(len(others)):
        seen = row[3 * k] > 0.0
        others[k, 0] = row[3 * k + 1] * sight_m if seen else np.nan
        others[k, 1] = row[3 * k + 2] * sight_m if seen else np.nan
