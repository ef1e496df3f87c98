"""Chipmunk, the solver that pymunk ships, called from compiled kernels: no interpreter between two substeps.

Kernels get the addresses of the library's functions in one array and call them through `call_*`. On x86-64 (System V)
and on AArch64 a `cpVect` passed by value is the same as two doubles, and a returned one comes as a pair of doubles.
"""

from __future__ import annotations

import platform
import sys
from typing import Any

import numpy as np
import pymunk._chipmunk_cffi as chipmunk
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from imagine.core.errors import WorkError

FUNCTIONS = (
    "cpSpaceNew", "cpSpaceFree", "cpSpaceStep", "cpSpaceGetStaticBody", "cpSpaceAddBody", "cpSpaceAddShape",
    "cpSpaceRemoveBody", "cpSpaceRemoveShape", "cpSpaceSetIterations", "cpSpaceSetCollisionSlop",
    "cpSpaceSetCollisionBias", "cpSpaceAddCollisionHandler", "cpBodyNew", "cpBodyNewKinematic", "cpBodyFree",
    "cpBodyGetPosition", "cpBodySetPosition", "cpBodyGetVelocity", "cpBodySetVelocity", "cpBodySetForce",
    "cpBodyGetAngle", "cpBodySetAngle", "cpBodyGetAngularVelocity", "cpBodySetTorque", "cpCircleShapeNew",
    "cpSegmentShapeNew", "cpSegmentShapeSetNeighbors", "cpPolyShapeNewRaw", "cpBoxShapeNew", "cpShapeFree",
    "cpShapeSetCollisionType", "cpShapeSetFilter", "cpArbiterGetBodies",
)  # fmt: skip
"""The functions whose addresses `addresses` returns, in the order of the constants below."""
(
    SPACE_NEW, SPACE_FREE, SPACE_STEP, SPACE_STATIC_BODY, SPACE_ADD_BODY, SPACE_ADD_SHAPE,
    SPACE_REMOVE_BODY, SPACE_REMOVE_SHAPE, SPACE_SET_ITERATIONS, SPACE_SET_SLOP,
    SPACE_SET_BIAS, SPACE_ADD_HANDLER, BODY_NEW, BODY_NEW_KINEMATIC, BODY_FREE,
    BODY_POSITION, BODY_SET_POSITION, BODY_VELOCITY, BODY_SET_VELOCITY, BODY_SET_FORCE,
    BODY_ANGLE, BODY_SET_ANGLE, BODY_ANGULAR_VELOCITY, BODY_SET_TORQUE, CIRCLE_NEW,
    SEGMENT_NEW, SEGMENT_SET_NEIGHBORS, POLY_NEW, BOX_NEW, SHAPE_FREE,
    SHAPE_SET_TYPE, SHAPE_SET_FILTER, ARBITER_BODIES,
) = range(len(FUNCTIONS))  # fmt: skip

PRE_SOLVE_OFFSET: int = chipmunk.ffi.offsetof("cpCollisionHandler", "preSolveFunc")
USER_DATA_OFFSET: int = chipmunk.ffi.offsetof("cpCollisionHandler", "userData")

_intrinsic: Any = intrinsic  # what callers write, without the typing context, is not what is declared
_MACHINES = ("x86_64", "amd64", "aarch64", "arm64")


def addresses() -> NDArray[np.int64]:
    """Return the addresses of `FUNCTIONS` in this process. Raises WorkError on a machine with other calling rules."""
    if sys.platform == "win32" or platform.machine().lower() not in _MACHINES or sys.maxsize < 2**63 - 1:
        raise WorkError(
            f"the twin's solver cannot be called from kernels on {sys.platform} {platform.machine()}: "
            "run it on 64-bit Linux or macOS, x86-64 or ARM"
        )
    ffi, lib = chipmunk.ffi, chipmunk.lib
    return np.array([int(ffi.cast("intptr_t", ffi.addressof(lib, name))) for name in FUNCTIONS], np.int64)


_POINTER = ir.IntType(64)
_DOUBLE = ir.DoubleType()
_VECTOR = ir.LiteralStructType([_DOUBLE, _DOUBLE])
_PAIR: Any = types.UniTuple(types.float64, 2)  # type: ignore[no-untyped-call]


def _call(context: Any, builder: Any, signature: Any, values: Any, result: Any) -> Any:
    """Emit the call of the function at an address with the members of a tuple (addresses, integers or doubles)."""
    address, packed = values
    arguments = []
    members = cgutils.unpack_tuple(builder, packed)  # type: ignore[no-untyped-call]
    for value, kind in zip(members, signature.args[1].types, strict=True):
        wanted = types.float64 if isinstance(kind, types.Float) else types.int64
        arguments.append(context.cast(builder, value, kind, wanted))
    function_type = ir.FunctionType(result, [argument.type for argument in arguments])
    function = builder.inttoptr(address, function_type.as_pointer())
    return builder.call(function, arguments)


@_intrinsic
def call_void(typing_context, address, arguments):  # type: ignore[no-untyped-def]
    """Call the C function at `address` with a tuple of integers (also addresses) and doubles."""

    def generate(context, builder, signature, values):  # type: ignore[no-untyped-def]
        _call(context, builder, signature, values, ir.VoidType())
        return context.get_dummy_value()

    return types.void(types.int64, arguments), generate


@_intrinsic
def call_address(typing_context, address, arguments):  # type: ignore[no-untyped-def]
    """Call the C function at `address`, which returns a pointer; return that as an integer."""

    def generate(context, builder, signature, values):  # type: ignore[no-untyped-def]
        return _call(context, builder, signature, values, _POINTER)

    return types.int64(types.int64, arguments), generate


@_intrinsic
def call_double(typing_context, address, arguments):  # type: ignore[no-untyped-def]
    """Call the C function at `address`, which returns a double."""

    def generate(context, builder, signature, values):  # type: ignore[no-untyped-def]
        return _call(context, builder, signature, values, _DOUBLE)

    return types.float64(types.int64, arguments), generate


@_intrinsic
def call_vector(typing_context, address, arguments):  # type: ignore[no-untyped-def]
    """Call the C function at `address`, which returns a cpVect; return its x and y."""

    def generate(context, builder, signature, values):  # type: ignore[no-untyped-def]
        vector = _call(context, builder, signature, values, _VECTOR)
        x, y = builder.extract_value(vector, 0), builder.extract_value(vector, 1)
        return context.make_tuple(builder, _PAIR, (x, y))

    return _PAIR(types.int64, arguments), generate


@_intrinsic
def load(typing_context, address):  # type: ignore[no-untyped-def]
    """Return the 64-bit integer at an address."""

    def generate(context, builder, signature, values):  # type: ignore[no-untyped-def]
        return builder.load(builder.inttoptr(values[0], _POINTER.as_pointer()))

    return types.int64(types.int64), generate


@_intrinsic
def store(typing_context, address, value):  # type: ignore[no-untyped-def]
    """Write a 64-bit integer to an address."""

    def generate(context, builder, signature, values):  # type: ignore[no-untyped-def]
        builder.store(values[1], builder.inttoptr(values[0], _POINTER.as_pointer()))
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), generate
