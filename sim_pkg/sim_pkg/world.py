"""Rigid-body physics of many arenas.

Discs and boxes in a walled plane, the discs driven by velocity commands. Every arena has a
Space of its own, and every episode a fresh, unthreaded one: contact caches and the order of
contacts would otherwise carry one episode's history into the next one's last bits.

spaces.py, which is compiled, is what calls Chipmunk: one loop over all arenas, because a call from
Python costs more than a substep.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import astuple

import numpy as np
import numpy.typing as npt

from sim_pkg import spaces
from sim_pkg.world_spec import BoxSpec, DiscSpec, WorldSpec, box_walls

__all__ = ["BoxSpec", "DiscSpec", "Float64Array", "World", "WorldSpec", "box_walls"]

Float64Array = npt.NDArray[np.float64]
Addresses = npt.NDArray[np.uint64]


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
        n, k, w = len(spec.discs), len(spec.boxes), len(spec.walls_m)
        self._substep_s = spec.dt_s / spec.substeps
        self._walls = _table(spec.walls_m, 4)
        self._discs = _table([astuple(disc) for disc in spec.discs], 5)
        self._boxes = _table([astuple(box) for box in spec.boxes], 5)
        driven = np.isfinite([disc.drive_n for disc in spec.discs])
        m = int(driven.sum())
        # Of each disc's body: itself, or what drives it, which comes after all discs and boxes.
        self._commanded = np.where(driven, n + k + np.cumsum(driven) - 1, np.arange(n))
        self._floor_arm_m = self._boxes[:, -1].copy()
        self._spaces = np.zeros(n_arenas, dtype=np.uint64)
        self._bodies = np.zeros((n_arenas, n + k + m), dtype=np.uint64)
        self._shapes = np.zeros((n_arenas, w + n + k), dtype=np.uint64)
        self._joints = np.zeros((n_arenas, 2 * k + m), dtype=np.uint64)
        self.bodies = np.zeros((n_arenas, n + k, 4), dtype=np.float64)
        self.turns = np.zeros((n_arenas, n + k, 2), dtype=np.float64)
        self.commands = np.zeros((n_arenas, n, 2), dtype=np.float64)
        self.floor_n = np.zeros((n_arenas, k), dtype=np.float64)
        freed = weakref.finalize(
            self, _free, self._spaces, self._bodies, self._shapes, self._joints
        )
        freed.atexit = False  # the process takes its memory with it

    def place(self, arena: int, positions_m: Float64Array) -> None:
        """Starts an episode in ``arena``: a fresh Space, all at rest. positions_m: (n + k, 2)."""
        spec = self.spec
        spaces.build(
            arena, spec.iterations, spec.slop_m, spec.penetration_left, spec.speed_left,
            self._walls, spec.wall_radius_m, spec.wall_friction, self._discs, self._boxes,
            positions_m, self._spaces, self._bodies, self._shapes, self._joints,
        )  # fmt: skip
        spaces.report(arena, len(spec.boxes) > 0, self._bodies, self.bodies, self.turns)

    def take_out(self, discs: npt.NDArray[np.bool_]) -> None:
        """From now on to their episode's end the discs marked in (B, n) collide with nothing.

        They keep their rows, and move as commanded: command 0 to leave one where it is.
        """
        spaces.take_out(discs, len(self._walls), self._spaces, self._shapes)

    def advance(self, running: npt.NDArray[np.bool_]) -> None:
        """Drives the discs of the running arenas at ``commands`` for ``spec.dt_s``.

        running: (B,); every running arena has been placed.
        """
        spaces.advance(
            running, self.spec.substeps, self._substep_s, self._commanded, self._floor_arm_m,
            self.commands, self.floor_n, self._spaces, self._bodies, self._joints, self.bodies,
            self.turns,
        )  # fmt: skip


def _table(rows: Sequence[tuple[float, ...]], columns: int) -> Float64Array:
    return np.array(rows, dtype=np.float64).reshape(len(rows), columns)


def _free(held: Addresses, bodies: Addresses, shapes: Addresses, joints: Addresses) -> None:
    """What a World held, when it is no longer referenced.

    One in which nothing was placed calls no compiled code: a signal may have come while it loaded.
    """
    for arena in np.flatnonzero(held).tolist():
        spaces.take_down(arena, held, bodies, shapes, joints)
