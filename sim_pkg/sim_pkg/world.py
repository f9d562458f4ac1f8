"""Rigid-body physics of many arenas: the only user of pymunk.

Discs and boxes in a walled plane, the discs driven by velocity commands. Every arena has a
Space of its own, and every episode a fresh, unthreaded one: contact caches and the order of
contacts would otherwise carry one episode's history into the next one's last bits.

This file calls Chipmunk through the binding that pymunk itself is written on, because pymunk's
Python objects cost more than the physics (a Space with two discs: 70 us against 12 us; a
substep: 0.9 us against 0.3 us). That binding is private: requirements.in pins the version, and
tests/sim/test_world.py holds every bit against the same scene built with pymunk's public classes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from pymunk._chipmunk_cffi import ffi, lib
from pymunk.batch import BodyFields

from sim_pkg.world_spec import BoxSpec, DiscSpec, WorldSpec, box_walls

__all__ = ["BoxSpec", "DiscSpec", "Float64Array", "World", "WorldSpec", "box_walls"]

Float64Array = npt.NDArray[np.float64]

# pymunk 7.3 asks for room for this many more doubles than it writes; with less it would
# reallocate the buffer, which numpy owns.
SPARE_DOUBLES = 3
# Walls hang on the Space's static body, which the batch functions report after the discs.
STATIC_ROWS = 1

_READ = BodyFields.POSITION | BodyFields.VELOCITY
_WRITE = BodyFields.VELOCITY
_READ_WIDTH = 4  # x, y, vx, vy
_TURN = BodyFields.ANGLE | BodyFields.ANGULAR_VELOCITY
_TURN_WIDTH = 2
_WRITE_WIDTH = 2  # vx, vy
_GET_ROW = ffi.addressof(lib, "pmSpaceBodyGetIteratorFuncBatched")
_SET_ROW = ffi.addressof(lib, "pmSpaceBodySetIteratorFuncBatched")
_ALL_CATEGORIES = 0xFFFFFFFF


@dataclass(frozen=True)
class _Parts:
    """What of a Space is written to before the physics advances, or taken out.

    ``commanded``: per disc the cpBody that takes its commanded velocity, itself or its drive.
    ``floors``: per box the joints of the floor's friction against sliding and turning.
    ``hulls``: per disc the shape that collides.
    """

    commanded: list[Any]
    floors: list[tuple[Any, Any]]
    hulls: list[Any]


class World:
    """B arenas with the same n discs, k boxes and walls.

    Attributes:
        spec: what every arena contains.
        bodies: (B, n + k, 4) float64: x, y in m and vx, vy in m/s of each disc, then of each
            box, refreshed by ``place`` and ``advance``. Read only.
        turns: (B, n + k, 2) float64: angle in rad and angular velocity in rad/s of the same;
            zero where there are no boxes. Read only.
        commands: (B, n, 2) float64: the velocities in m/s that the next ``advance`` sets or,
            with a limited drive, steers to.
        floor_n: (B, k) float64: the force in N with which the floor resists each box's sliding
            during the next ``advance``.
    """

    def __init__(self, spec: WorldSpec, n_arenas: int) -> None:
        self.spec = spec
        n, k = len(spec.discs), len(spec.boxes)
        n_driven = sum(math.isfinite(disc.drive_n) for disc in spec.discs)
        self._commands_only = n_driven == k == 0  # every row but the static one is a command
        rows = n + k + n_driven + STATIC_ROWS
        self._substep_s = spec.dt_s / spec.substeps
        self._walls = [((x1, y1), (x2, y2)) for x1, y1, x2, y2 in spec.walls_m]
        self._spaces: list[Any] = [None] * n_arenas
        self._parts: list[_Parts] = [_Parts([], [], [])] * n_arenas
        self._read = _Rows(n_arenas, rows * _READ_WIDTH, _READ)
        self._write = _Rows(n_arenas, rows * _WRITE_WIDTH, _WRITE)
        self._turn = _Rows(n_arenas, rows * _TURN_WIDTH, _TURN) if k else None
        self.bodies = self._read.view(n + k, _READ_WIDTH)
        self.turns = (
            self._turn.view(n + k, _TURN_WIDTH) if self._turn else np.zeros((n_arenas, n, 2))
        )
        self.commands = self._write.view(n, _WRITE_WIDTH)
        self.floor_n = np.zeros((n_arenas, k), dtype=np.float64)

    def place(self, arena: int, positions_m: Float64Array) -> None:
        """Starts an episode in ``arena``: a fresh Space, all at rest. positions_m: (n + k, 2)."""
        space, self._parts[arena] = self._new_space(positions_m.tolist())
        self._spaces[arena] = space
        self._report(space, arena)

    def take_out(self, arena: int, disc: int) -> None:
        """From now on to the episode's end the disc collides with nothing.

        It keeps its row, and moves as commanded: command 0 to leave it where it is.
        """
        lib.cpSpaceRemoveShape(self._spaces[arena], self._parts[arena].hulls[disc])

    def advance(self, running: npt.NDArray[np.bool_]) -> None:
        """Drives the discs of the running arenas at ``commands`` for ``spec.dt_s``.

        running: (B,); every running arena has been placed.
        """
        step, substep_s = lib.cpSpaceStep, self._substep_s
        substeps = range(self.spec.substeps)
        for arena in np.flatnonzero(running).tolist():
            space = self._spaces[arena]
            self._order(space, arena)
            for _ in substeps:
                step(space, substep_s)
            self._report(space, arena)

    def _order(self, space: Any, arena: int) -> None:
        """Hands the arena's commands to its drives, and the floor's friction to its boxes."""
        parts = self._parts[arena]
        if self._commands_only:
            self._write.transfer(space, arena, _SET_ROW)
            return
        self._write.transfer_to(parts.commanded, arena, _SET_ROW)
        for (slide, turn), box, force_n in zip(
            parts.floors, self.spec.boxes, self.floor_n[arena].tolist(), strict=True
        ):
            lib.cpConstraintSetMaxForce(slide, force_n)
            lib.cpConstraintSetMaxForce(turn, force_n * box.floor_arm_m)

    def _report(self, space: Any, arena: int) -> None:
        self._read.transfer(space, arena, _GET_ROW)
        if self._turn is not None:
            self._turn.transfer(space, arena, _GET_ROW)

    def _new_space(self, positions_m: list[tuple[float, float]]) -> tuple[Any, _Parts]:
        """A cpSpace that frees itself and its contents when it is no longer referenced."""
        spec, n = self.spec, len(self.spec.discs)
        space = lib.cpSpaceNew()
        lib.cpSpaceSetIterations(space, spec.iterations)
        lib.cpSpaceSetCollisionSlop(space, spec.slop_m)
        lib.cpSpaceSetCollisionBias(space, spec.penetration_left)
        lib.cpSpaceSetDamping(space, spec.speed_left)
        build = _Builder(space)
        for start, end in self._walls:
            build.wall(start, end, spec.wall_radius_m, spec.wall_friction)
        made = [build.disc(d, at) for d, at in zip(spec.discs, positions_m[:n], strict=True)]
        floors = [build.box(b, at) for b, at in zip(spec.boxes, positions_m[n:], strict=True)]
        # The drives come last, so that the rows of discs and boxes are as World says.
        commanded = [
            build.drive(body, disc.drive_n) if math.isfinite(disc.drive_n) else body
            for (body, _), disc in zip(made, spec.discs, strict=True)
        ]
        return ffi.gc(space, build.free), _Parts(commanded, floors, [hull for _, hull in made])


class _Builder:
    """Fills a cpSpace, and frees it with all that it put in."""

    def __init__(self, space: Any) -> None:
        self._space = space
        self._floor = lib.cpSpaceGetStaticBody(space)
        self._bodies: list[Any] = []
        self._shapes: list[Any] = []
        self._joints: list[Any] = []

    def wall(
        self, start: tuple[float, float], end: tuple[float, float], radius_m: float, friction: float
    ) -> None:
        shape = lib.cpSegmentShapeNew(self._floor, start, end, radius_m)
        self._add_shape(shape, friction)

    def disc(self, disc: DiscSpec, position_m: tuple[float, float]) -> tuple[Any, Any]:
        """Its body and its shape."""
        # An infinite moment: the robots keep their heading (omnidirectional drive).
        body = self._add_body(lib.cpBodyNew(disc.mass_kg, np.inf))
        lib.cpBodySetPosition(body, position_m)
        shape = lib.cpCircleShapeNew(body, disc.radius_m, (0.0, 0.0))
        if disc.group:
            lib.cpShapeSetFilter(shape, (disc.group, _ALL_CATEGORIES, _ALL_CATEGORIES))
        self._add_shape(shape, disc.friction)
        return body, shape

    def box(self, box: BoxSpec, position_m: tuple[float, float]) -> tuple[Any, Any]:
        """The joints by which the floor resists sliding and turning.

        They hold the velocity at 0, not the position, with no more than a maximal force, which
        is dry friction.
        """
        moment = lib.cpMomentForBox(box.mass_kg, box.width_m, box.height_m)
        body = self._add_body(lib.cpBodyNew(box.mass_kg, moment))
        lib.cpBodySetPosition(body, position_m)
        self._add_shape(lib.cpBoxShapeNew(body, box.width_m, box.height_m, 0.0), box.friction)
        slide = lib.cpPivotJointNew2(self._floor, body, (0.0, 0.0), (0.0, 0.0))
        turn = lib.cpGearJointNew(self._floor, body, 0.0, 1.0)
        return self._add_joint(slide), self._add_joint(turn)

    def drive(self, body: Any, force_n: float) -> Any:
        """A kinematic body whose velocity ``body`` is drawn to with at most ``force_n``."""
        motor = self._add_body(lib.cpBodyNewKinematic())
        joint = lib.cpPivotJointNew2(motor, body, (0.0, 0.0), (0.0, 0.0))
        lib.cpConstraintSetMaxForce(self._add_joint(joint), force_n)
        return motor

    def free(self, space: Any) -> None:
        lib.cpSpaceFree(space)
        for joint in self._joints:
            lib.cpConstraintFree(joint)
        for shape in self._shapes:
            lib.cpShapeFree(shape)
        for body in self._bodies:
            lib.cpBodyFree(body)

    def _add_body(self, body: Any) -> Any:
        self._bodies.append(body)
        return lib.cpSpaceAddBody(self._space, body)

    def _add_shape(self, shape: Any, friction: float) -> None:
        self._shapes.append(shape)
        if friction:
            lib.cpShapeSetFriction(shape, friction)
        lib.cpSpaceAddShape(self._space, shape)

    def _add_joint(self, joint: Any) -> Any:
        self._joints.append(joint)
        lib.cpConstraintSetMaxBias(joint, 0.0)
        return lib.cpSpaceAddConstraint(self._space, joint)


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

    def transfer_to(self, bodies: list[Any], arena: int, each: Any) -> None:
        """Runs ``each`` over ``bodies`` from the start of the arena's row."""
        self._floats[arena].num = 0
        job = self._batches[arena]
        for body in bodies:
            each(body, job)
