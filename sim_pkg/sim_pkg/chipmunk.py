"""Chipmunk's functions for compiled code: the only user of pymunk, whose library has them.

Compiled code calls them by their C names, with nothing of Python between, which would cost more
than the physics. A cpSpace, cpBody, cpShape or cpConstraint is its address. A cpVect, which C takes
by value, is given as two doubles, which is the same on x86-64 and on 64-bit ARM; a returned one is
a complex number. A cpShapeFilter is its group, and the bits of its categories and mask.

Arguments and results are as pymunk's own binding declares them. That binding is private:
requirements.in pins the version, and tests/sim/test_world.py holds every bit against the same
scene built with pymunk's public classes.
"""

from __future__ import annotations

from typing import Any

from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from pymunk import _chipmunk
from pymunk._chipmunk_cffi import ffi, lib

binding.load_library_permanently(_chipmunk.__file__)

_ADDRESS, _DOUBLE = types.uintp, types.float64
# By what C calls it: what a value is passed as.
_PASSED = {
    "double": (_DOUBLE,),
    "int": (types.int32,),
    "struct cpVect": (_DOUBLE, _DOUBLE),
    "struct cpShapeFilter": (types.uint64, types.uint64),
}


def _function(name: str) -> Any:
    declared = ffi.typeof(getattr(lib, name))
    result = declared.result.cname
    arguments = [passed for kind in declared.args for passed in _passed(kind)]
    if result == "struct cpVect":
        return _vector_of_body(name)
    returned = types.void if result == "void" else _passed(declared.result)[0]
    return types.ExternalFunction(name, returned(*arguments))


def _passed(kind: Any) -> tuple[types.Type, ...]:
    return (_ADDRESS,) if kind.kind == "pointer" else _PASSED[kind.cname]


def _vector_of_body(name: str) -> Any:
    """As _function, of a cpVect: ExternalFunction returns numbers only."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        pair = ir.LiteralStructType([ir.DoubleType()] * 2)
        kind = ir.FunctionType(pair, [argument.type for argument in arguments])
        function = cgutils.get_or_insert_function(  # type: ignore[no-untyped-call]
            builder.module, kind, name
        )
        return builder.call(function, arguments)

    @intrinsic
    def call(_context, _body):  # type: ignore[no-untyped-def]
        return types.complex128(_ADDRESS), generate

    return call


cpSpaceNew = _function("cpSpaceNew")
cpSpaceFree = _function("cpSpaceFree")
cpSpaceStep = _function("cpSpaceStep")
cpSpaceGetStaticBody = _function("cpSpaceGetStaticBody")
cpSpaceSetIterations = _function("cpSpaceSetIterations")
cpSpaceSetCollisionSlop = _function("cpSpaceSetCollisionSlop")
cpSpaceSetCollisionBias = _function("cpSpaceSetCollisionBias")
cpSpaceSetDamping = _function("cpSpaceSetDamping")
cpSpaceAddBody = _function("cpSpaceAddBody")
cpSpaceAddShape = _function("cpSpaceAddShape")
cpSpaceAddConstraint = _function("cpSpaceAddConstraint")
cpSpaceRemoveShape = _function("cpSpaceRemoveShape")

cpBodyNew = _function("cpBodyNew")
cpBodyNewKinematic = _function("cpBodyNewKinematic")
cpBodyFree = _function("cpBodyFree")
cpBodySetPosition = _function("cpBodySetPosition")
cpBodySetVelocity = _function("cpBodySetVelocity")
cpBodyGetPosition = _function("cpBodyGetPosition")
cpBodyGetVelocity = _function("cpBodyGetVelocity")
cpBodyGetAngle = _function("cpBodyGetAngle")
cpBodyGetAngularVelocity = _function("cpBodyGetAngularVelocity")
cpMomentForBox = _function("cpMomentForBox")

cpSegmentShapeNew = _function("cpSegmentShapeNew")
cpCircleShapeNew = _function("cpCircleShapeNew")
cpBoxShapeNew = _function("cpBoxShapeNew")
cpShapeFree = _function("cpShapeFree")
cpShapeSetFriction = _function("cpShapeSetFriction")
cpShapeSetFilter = _function("cpShapeSetFilter")

cpPivotJointNew2 = _function("cpPivotJointNew2")
cpGearJointNew = _function("cpGearJointNew")
cpConstraintFree = _function("cpConstraintFree")
cpConstraintSetMaxForce = _function("cpConstraintSetMaxForce")
cpConstraintSetMaxBias = _function("cpConstraintSetMaxBias")
