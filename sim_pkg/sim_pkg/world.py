"""Rigid-body physics of many arenas: the only user of pymunk.

Discs in a walled plane, driven by velocity commands. Every arena has a Space of its own, and
every episode a fresh, unthreaded one: contact caches and the order of contacts would otherwise
carry one episode's history into the next one's last bits.

This file calls Chipmunk through the binding that pymunk itself is written on, because pymunk's
Python objects cost more than the physics (a Space with two discs: 70 us against 12 us; a
substep: 0.9 us against 0.3 us). That binding is private: requirements.in pins the version, and
tests/sim/test_world.py holds every bit against the same scene built with pymunk's public classes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from pymunk._chipmunk_cffi import ffi, lib
from pymunk.batch import BodyFields

Float64Array = npt.NDArray[np.float64]

# pymunk 7.3 asks for room for this many more doubles than it writes; with less it would
# reallocate the buffer, which numpy owns.
SPARE_DOUBLES = 3
# Walls hang on the Space's static body, which the batch functions report after the discs.
STATIC_ROWS = 1

_READ = BodyFields.POSITION | BodyFields.VELOCITY
_WRITE = BodyFields.VELOCITY
_READ_WIDTH = 4  # x, y, vx, vy
_WRITE_WIDTH = 2  # vx, vy
_GET_ROW = ffi.addressof(lib, "pmSpaceBodyGetIteratorFuncBatched")
_SET_ROW = ffi.addressof(lib, "pmSpaceBodySetIteratorFuncBatched")
_ALL_CATEGORIES = 0xFFFFFFFF


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
        self._walls = [((x1, y1), (x2, y2)) for x1, y1, x2, y2 in spec.walls_m]
        self._spaces: list[Any] = [None] * n_arenas
        self._read = _Rows(n_arenas, rows * _READ_WIDTH, _READ)
        self._write = _Rows(n_arenas, rows * _WRITE_WIDTH, _WRITE)
        self.bodies = self._read.view(n, _READ_WIDTH)
        self.commands = self._write.view(n, _WRITE_WIDTH)

    def place(self, arena: int, positions_m: Float64Array) -> None:
        """Starts an episode in ``arena``: a fresh Space, discs at rest. positions_m: (n, 2)."""
        space = self._new_space(positions_m.tolist())
        self._spaces[arena] = space
        self._read.transfer(space, arena, _GET_ROW)

    def advance(self, running: npt.NDArray[np.bool_]) -> None:
        """Drives the discs of the running arenas at ``commands`` for one control step.

        running: (B,); every running arena has been placed.
        """
        step, substep_s = lib.cpSpaceStep, self._substep_s
        substeps = range(self._spec.substeps)
        write, read = self._write.transfer, self._read.transfer
        for arena in np.flatnonzero(running).tolist():
            space = self._spaces[arena]
            write(space, arena, _SET_ROW)
            for _ in substeps:
                step(space, substep_s)
            read(space, arena, _GET_ROW)

    def _new_space(self, positions_m: list[tuple[float, float]]) -> Any:
        """A cpSpace that frees itself and its contents when it is no longer referenced."""
        spec = self._spec
        space = lib.cpSpaceNew()
        lib.cpSpaceSetIterations(space, spec.iterations)
        lib.cpSpaceSetCollisionSlop(space, spec.slop_m)
        lib.cpSpaceSetCollisionBias(space, spec.penetration_left)
        shapes, bodies = [], []
        for start, end in self._walls:
            wall = lib.cpSegmentShapeNew(
                lib.cpSpaceGetStaticBody(space), start, end, spec.wall_radius_m
            )
            lib.cpShapeSetFriction(wall, spec.wall_friction)
            lib.cpSpaceAddShape(space, wall)
            shapes.append(wall)
        for disc, position in zip(spec.discs, positions_m, strict=True):
            # An infinite moment: the robots keep their heading (omnidirectional drive).
            body = lib.cpBodyNew(disc.mass_kg, np.inf)
            lib.cpBodySetPosition(body, position)
            lib.cpSpaceAddBody(space, body)
            shape = lib.cpCircleShapeNew(body, disc.radius_m, (0.0, 0.0))
            lib.cpShapeSetFriction(shape, disc.friction)
            lib.cpShapeSetFilter(shape, (disc.group, _ALL_CATEGORIES, _ALL_CATEGORIES))
            lib.cpSpaceAddShape(space, shape)
            bodies.append(body)
            shapes.append(shape)
        return ffi.gc(space, partial(_free, shapes, bodies))


def _free(shapes: list[Any], bodies: list[Any], space: Any) -> None:
    lib.cpSpaceFree(space)
    for shape in shapes:
        lib.cpShapeFree(shape)
    for body in bodies:
        lib.cpBodyFree(body)


class _Rows:
    """One numpy row per arena that pymunk's batch functions write to or read from."""

    def __init__(self, n_arenas: int, width: int, fields: BodyFields) -> None:
        self._memory = np.zeros((n_arenas, width + SPARE_DOUBLES), dtype=np.float64)
        self._keep: list[Any] = []
        self._floats: list[Any] = []
        self._batches: list[Any] = []
        for row in self._memory:
            floats = ffi.new("pmFloatArray *")
            ints = ffi.new("pmIntArray *")
            floats.arr = ffi.from_buffer("cpFloat[]", row)
            floats.max = len(row)
            job = ffi.new("pmBatchedData *", (ints, floats, fields.value))
            self._keep.append((row, ints, floats.arr))
            self._floats.append(floats)
            self._batches.append(job)

    def view(self, n: int, width: int) -> Float64Array:
        """(B, n, width) view of the discs' part of the memory."""
        return self._memory[:, : n * width].reshape(len(self._memory), n, width)

    def transfer(self, space: Any, arena: int, each: Any) -> None:
        """Runs ``each`` over the space's bodies from the start of the arena's row."""
        self._floats[arena].num = 0
        lib.cpSpaceEachBody(space, each, self._batches[arena])
