"""Compiled: the Chipmunk Spaces of a World, one per arena: built, advanced, taken down.

B arenas, each with n discs, k boxes and w walls, and a driving body for each of the m discs whose
drive is limited. What an arena consists of, as addresses (uint64; 0: nothing yet):

    space: (B,).
    bodies: (B, n + k + m) discs, boxes, driving bodies.
    shapes: (B, w + n + k) of walls, discs, boxes.
    joints: (B, 2 k + m) by which the floor resists each box's sliding and turning; of the drives.

The columns of ``walls``, ``discs`` and ``boxes`` are the fields of world_spec.py, in their order.
"""

from __future__ import annotations

import numpy as np

from sim_pkg.chipmunk import (
    cpBodyFree,
    cpBodyGetAngle,
    cpBodyGetAngularVelocity,
    cpBodyGetPosition,
    cpBodyGetVelocity,
    cpBodyNew,
    cpBodyNewKinematic,
    cpBodySetPosition,
    cpBodySetVelocity,
    cpBoxShapeNew,
    cpCircleShapeNew,
    cpConstraintFree,
    cpConstraintSetMaxBias,
    cpConstraintSetMaxForce,
    cpGearJointNew,
    cpMomentForBox,
    cpPivotJointNew2,
    cpSegmentShapeNew,
    cpShapeFree,
    cpShapeSetFilter,
    cpShapeSetFriction,
    cpSpaceAddBody,
    cpSpaceAddConstraint,
    cpSpaceAddShape,
    cpSpaceFree,
    cpSpaceGetStaticBody,
    cpSpaceNew,
    cpSpaceRemoveShape,
    cpSpaceSetCollisionBias,
    cpSpaceSetCollisionSlop,
    cpSpaceSetDamping,
    cpSpaceSetIterations,
    cpSpaceStep,
)
from sim_pkg.compiled import entry, helper

ALL_CATEGORIES = np.uint64(0xFFFFFFFF_FFFFFFFF)  # and the mask of all


@entry
def build(  # type: ignore[no-untyped-def]
    arena, iterations, slop_m, penetration_left, speed_left, walls, wall_radius_m, wall_friction,
    discs, boxes, positions_m, spaces, bodies, shapes, joints,
):  # fmt: skip
    """A fresh Space in ``arena``, all at rest, in the place of the one there was.

    The order in which things are added is that in which contacts are solved.
    """
    take_down(arena, spaces, bodies, shapes, joints)
    space = cpSpaceNew()
    spaces[arena] = space
    cpSpaceSetIterations(space, iterations)
    cpSpaceSetCollisionSlop(space, slop_m)
    cpSpaceSetCollisionBias(space, penetration_left)
    cpSpaceSetDamping(space, speed_left)
    floor = cpSpaceGetStaticBody(space)
    w, n, k = len(walls), len(discs), len(boxes)
    for i in range(w):
        x1, y1, x2, y2 = walls[i]
        shape = cpSegmentShapeNew(floor, x1, y1, x2, y2, wall_radius_m)
        shapes[arena, i] = _add_shape(space, shape, wall_friction)
    for i in range(n):
        radius_m, mass_kg, friction, group, _ = discs[i]
        # An infinite moment: the robots keep their heading (omnidirectional drive).
        body = _add_body(space, cpBodyNew(mass_kg, np.inf), positions_m[i])
        bodies[arena, i] = body
        shape = cpCircleShapeNew(body, radius_m, 0.0, 0.0)
        if group:
            cpShapeSetFilter(shape, np.uint64(group), ALL_CATEGORIES)
        shapes[arena, w + i] = _add_shape(space, shape, friction)
    for i in range(k):
        width_m, height_m, mass_kg, friction, _ = boxes[i]
        moment = cpMomentForBox(mass_kg, width_m, height_m)
        body = _add_body(space, cpBodyNew(mass_kg, moment), positions_m[n + i])
        bodies[arena, n + i] = body
        shape = cpBoxShapeNew(body, width_m, height_m, 0.0)
        shapes[arena, w + n + i] = _add_shape(space, shape, friction)
        # They hold the velocity at 0, not the position, with no more than a maximal force, which
        # is dry friction.
        slide = cpPivotJointNew2(floor, body, 0.0, 0.0, 0.0, 0.0)
        joints[arena, 2 * i] = _add_joint(space, slide)
        joints[arena, 2 * i + 1] = _add_joint(space, cpGearJointNew(floor, body, 0.0, 1.0))
    _drive(arena, space, discs, k, bodies, joints)


@helper
def _drive(arena, space, discs, k, bodies, joints):  # type: ignore[no-untyped-def]
    """Kinematic bodies to whose velocity the discs are drawn with at most their drive's force."""
    n, driven = len(discs), 0
    for i in range(n):
        drive_n = discs[i, 4]
        if np.isfinite(drive_n):
            motor = cpSpaceAddBody(space, cpBodyNewKinematic())
            joint = cpPivotJointNew2(motor, bodies[arena, i], 0.0, 0.0, 0.0, 0.0)
            cpConstraintSetMaxForce(joint, drive_n)
            bodies[arena, n + k + driven] = motor
            joints[arena, 2 * k + driven] = _add_joint(space, joint)
            driven += 1


@helper
def _add_body(space, body, position_m):  # type: ignore[no-untyped-def]
    cpBodySetPosition(body, position_m[0], position_m[1])
    return cpSpaceAddBody(space, body)


@helper
def _add_shape(space, shape, friction):  # type: ignore[no-untyped-def]
    if friction:
        cpShapeSetFriction(shape, friction)
    return cpSpaceAddShape(space, shape)


@helper
def _add_joint(space, joint):  # type: ignore[no-untyped-def]
    cpConstraintSetMaxBias(joint, 0.0)
    return cpSpaceAddConstraint(space, joint)


@entry
def take_down(arena, spaces, bodies, shapes, joints):  # type: ignore[no-untyped-def]
    """Frees the Space of ``arena``, if there is one, and all that is in it."""
    if spaces[arena] == 0:
        return
    cpSpaceFree(spaces[arena])
    spaces[arena] = 0
    for joint in joints[arena]:
        cpConstraintFree(joint)
    for shape in shapes[arena]:
        cpShapeFree(shape)
    for body in bodies[arena]:
        cpBodyFree(body)


@entry
def take_out(discs, walls, spaces, shapes):  # type: ignore[no-untyped-def]
    """The shapes of the discs that are marked in (B, n) leave their Space."""
    for b in range(discs.shape[0]):
        for i in range(discs.shape[1]):
            if discs[b, i]:
                cpSpaceRemoveShape(spaces[b], shapes[b, walls + i])


@entry
def advance(  # type: ignore[no-untyped-def]
    running, substeps, substep_s, commanded, arm_m, commands, floor_n, spaces, bodies, joints, seen,
    turns,
):  # fmt: skip
    """Orders, steps and reports the running arenas.

    commanded: (n,) the column of ``bodies`` that takes each disc's command. arm_m: (k,) at which
    the floor's friction acts on a box that turns. ``seen``, ``turns``: World.bodies, World.turns.
    """
    for b in range(len(running)):
        if not running[b]:
            continue
        space = spaces[b]
        if space == 0:
            raise ValueError("an arena advances in which nothing has been placed")
        for i in range(len(commanded)):
            cpBodySetVelocity(bodies[b, commanded[i]], commands[b, i, 0], commands[b, i, 1])
        for i in range(len(arm_m)):
            cpConstraintSetMaxForce(joints[b, 2 * i], floor_n[b, i])
            cpConstraintSetMaxForce(joints[b, 2 * i + 1], floor_n[b, i] * arm_m[i])
        for _ in range(substeps):
            cpSpaceStep(space, substep_s)
        report(b, len(arm_m) > 0, bodies, seen, turns)


@entry
def report(b, turning, bodies, seen, turns):  # type: ignore[no-untyped-def]
    """Where the arena's discs and boxes are, and how fast; ``turning``: also their angles."""
    for i in range(seen.shape[1]):
        body = bodies[b, i]
        place, velocity = cpBodyGetPosition(body), cpBodyGetVelocity(body)
        seen[b, i, 0], seen[b, i, 1] = place.real, place.imag
        seen[b, i, 2], seen[b, i, 3] = velocity.real, velocity.imag
        if turning:
            turns[b, i, 0] = cpBodyGetAngle(body)
            turns[b, i, 1] = cpBodyGetAngularVelocity(body)
