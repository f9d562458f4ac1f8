"""What the arenas of a world contain: plain data for world.py."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class DiscSpec:
    """One disc. Discs of the same non-zero ``group`` pass through each other.

    ``drive_n`` is the most force that its drive can exert; infinite: it takes the commanded
    velocity at once.
    """

    radius_m: float
    mass_kg: float
    friction: float
    group: int = 0
    drive_n: float = math.inf


@dataclass(frozen=True)
class BoxSpec:
    """A free box that stands on the floor; ``friction`` is that of its sides.

    It starts parallel to the axes. ``floor_arm_m`` times the floor's friction force is the
    torque with which the floor resists turning.
    """

    width_m: float
    height_m: float
    mass_kg: float
    friction: float
    floor_arm_m: float


@dataclass(frozen=True)
class WorldSpec:
    """What every arena contains and how it is integrated: ``dt_s`` at a time, in ``substeps``.

    ``walls_m``: (x1, y1, x2, y2) of each wall's middle line; ``wall_radius_m`` is half its
    thickness. ``penetration_left`` is the share of a penetration that is left after a second,
    ``speed_left`` that of a body's speed which nothing drives (resistance that grows with
    speed: a force of ``-ln(speed_left)`` x mass x speed).
    """

    discs: tuple[DiscSpec, ...]
    walls_m: tuple[tuple[float, float, float, float], ...]
    wall_radius_m: float
    wall_friction: float
    dt_s: float
    substeps: int
    iterations: int
    slop_m: float
    penetration_left: float
    boxes: tuple[BoxSpec, ...] = ()
    speed_left: float = 1.0


def box_walls(
    width_m: float, height_m: float, inset_m: float, radius_m: float
) -> tuple[tuple[float, float, float, float], ...]:
    """Four walls whose inner faces lie ``inset_m`` inside a width x height rectangle at (0, 0)."""
    low = inset_m - radius_m
    right, top = width_m - low, height_m - low
    return (
        (low, low, right, low),
        (right, low, right, top),
        (right, top, low, top),
        (low, top, low, low),
    )
