"""Rigid-body physics of many arenas: the only user of pymunk.

Discs in a walled plane, driven by velocity commands. Every arena has a Space of its own, and
every episode a fresh, unthreaded one: contact caches and the order of contacts would otherwise
carry one episode's history into the next one's last bits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pymunk
from pymunk import batch

Float64Array = npt.NDArray[np.float64]

# pymunk 7.3 asks for room for this many more doubles than it writes; with less it would
# reallocate the buffer, which numpy owns.
SPARE_DOUBLES = 3
# Walls hang on the Space's static body, which the batch functions report after the discs.
STATIC_ROWS = 1

_READ = batch.BodyFields.POSITION | batch.BodyFields.VELOCITY
_WRITE = batch.BodyFields.VELOCITY
_READ_WIDTH = 4  # x, y, vx, vy
_WRITE_WIDTH = 2  # vx, vy


@dataclass(frozen=True)
class DiscSpec:
    """One disc. Discs of the same non-zero ``group`` pass through each other."""

    radius_m: float
    mass_kg: float
    friction: float
    group: int = 0


@dataclass(frozen=True)
class WorldSpec:
    """What every arena contains and how it is integrated.

    ``walls_m``: (x1, y1, x2, y2) of each wall's middle line; ``wall_radius_m`` is half its
    thickness. ``penetration_left`` is the share of a penetration that is left after a second.
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


class World:
    """B arenas with the same discs and walls.

    Attributes:
        bodies: (B, n, 4) float64: x, y in m and vx, vy in m/s of each disc, refreshed by
            ``place`` and ``advance``. Read only.
        commands: (B, n, 2) float64: the velocities in m/s that the next ``advance`` sets.
    """

    def __init__(self, spec: WorldSpec, n_arenas: int) -> None:
        self._spec = spec
        n = len(spec.discs)
        rows = n + STATIC_ROWS
        self._substep_s = spec.dt_s / spec.substeps
        self._spaces: list[pymunk.Space | None] = [None] * n_arenas
        self._filters = [pymunk.ShapeFilter(group=disc.group) for disc in spec.discs]
        self._read, self._readers = _buffers(n_arenas, rows * _READ_WIDTH)
        self._write, self._writers = _buffers(n_arenas, rows * _WRITE_WIDTH)
        self.bodies = self._read[:, : n * _READ_WIDTH].reshape(n_arenas, n, _READ_WIDTH)
        self.commands = self._write[:, : n * _WRITE_WIDTH].reshape(n_arenas, n, _WRITE_WIDTH)

    def place(self, arena: int, positions_m: Float64Array) -> None:
        """Starts an episode in ``arena``: a fresh Space, discs at rest. positions_m: (n, 2)."""
        spec = self._spec
        space = pymunk.Space()
        space.iterations = spec.iterations
        space.collision_slop = spec.slop_m
        space.collision_bias = spec.penetration_left
        parts: list[pymunk.Body | pymunk.Shape] = []
        for x1, y1, x2, y2 in spec.walls_m:
            wall = pymunk.Segment(space.static_body, (x1, y1), (x2, y2), spec.wall_radius_m)
            wall.friction = spec.wall_friction
            parts.append(wall)
        for disc, flt, position in zip(spec.discs, self._filters, positions_m.tolist(), strict=True):
            # An infinite moment: the robots keep their heading (omnidirectional drive).
            body = pymunk.Body(disc.mass_kg, float("inf"))
            body.position = position
            shape = pymunk.Circle(body, disc.radius_m)
            shape.friction = disc.friction
            shape.filter = flt
            parts += (body, shape)
        space.add(*parts)
        self._spaces[arena] = space
        self._refresh(space, arena)

    def advance(self, running: npt.NDArray[np.bool_]) -> None:
        """Drives the discs of the running arenas at ``commands`` for one control step.

        running: (B,); every running arena has been placed.
        """
        substep_s = self._substep_s
        substeps = range(self._spec.substeps)
        for arena in np.flatnonzero(running).tolist():
            space = self._spaces[arena]
            if space is None:
                raise RuntimeError(f"arena {arena} was never placed")
            batch.set_space_bodies(space, _WRITE, self._writers[arena])
            for _ in substeps:
                space.step(substep_s)
            self._refresh(space, arena)

    def _refresh(self, space: pymunk.Space, arena: int) -> None:
        reader = self._readers[arena]
        reader.clear()
        batch.get_space_bodies(space, _READ, reader)


def _buffers(n_arenas: int, width: int) -> tuple[Float64Array, list[batch.Buffer]]:
    """(B, width + spare) zeros, and a pymunk buffer over each row."""
    memory = np.zeros((n_arenas, width + SPARE_DOUBLES), dtype=np.float64)
    buffers = []
    for row in memory:
        buffer = batch.Buffer()
        buffer.set_float_buf(row)
        buffers.append(buffer)
    return memory, buffers
