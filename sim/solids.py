"""A level's geometry as the solver takes it, and the building and freeing of one world's space in compiled code.

A space is always built anew for an episode, never used again: what an old one remembers (tree, contacts, counters)
would make the next flight differ in its last bits from the same flight in a fresh one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import pymunk
from numpy.typing import NDArray

from imagine.sim.chipmunk import (
    BODY_FREE,
    BODY_NEW,
    BODY_NEW_KINEMATIC,
    BODY_SET_ANGLE,
    BODY_SET_POSITION,
    BOX_NEW,
    CIRCLE_NEW,
    POLY_NEW,
    PRE_SOLVE_OFFSET,
    SEGMENT_NEW,
    SEGMENT_SET_NEIGHBORS,
    SHAPE_FREE,
    SHAPE_SET_FILTER,
    SHAPE_SET_TYPE,
    SPACE_ADD_BODY,
    SPACE_ADD_HANDLER,
    SPACE_ADD_SHAPE,
    SPACE_FREE,
    SPACE_NEW,
    SPACE_SET_BIAS,
    SPACE_SET_ITERATIONS,
    SPACE_SET_SLOP,
    SPACE_STATIC_BODY,
    USER_DATA_OFFSET,
    call_address,
    call_void,
    store,
)
from imagine.sim.dynamics import MASS
from imagine.sim.level import Level
from imagine.sim.movers import (
    CRATE_MASS,
    CRATE_X,
    CRATE_Y,
    CRATE_YAW,
    HALF_DEPTH,
    HALF_WIDTH,
    RADIUS,
    X,
    Y,
    moment_of_box,
)

WALL, DRONE, CRATE, PERSON = 1, 2, 3, 4  # collision types
_EVERYTHING = 1 << WALL | 1 << DRONE | 1 << CRATE | 1 << PERSON
_ITERATIONS = 10
_SLOP_M = 0.0005  # the library's default is made for pixels
_BIAS = 1e-15  # half of an overlap is gone after a substep


@dataclass(frozen=True)
class Solids:
    """What stands still: `segments` `[n, 8]` (ends, then the ends' neighbours on the loop), convex polygons as
    counter-clockwise `vertices` `[k, 2]` from `starts[i]` to `starts[i + 1]`, and posts `[m, 3]`.
    """

    segments: NDArray[np.float64]
    vertices: NDArray[np.float64]
    starts: NDArray[np.int64]
    posts: NDArray[np.float64]

    @classmethod
    def of(cls, level: Level) -> Solids:
        """Return a level's walls: outline and solids as loops of edges, boxes and walls as polygons."""
        loops = [np.asarray(loop, float) for loop in (level.outline, *level.solids)]
        segments = [
            np.hstack((loop, np.roll(loop, -1, axis=0), np.roll(loop, 1, axis=0), np.roll(loop, -2, axis=0)))
            for loop in loops
        ]
        hulls = [
            np.array(pymunk.Poly(None, [(float(x), float(y)) for x, y in polygon]).get_vertices(), float)
            for polygon in level.polygons
        ]
        return cls(
            np.ascontiguousarray(np.concatenate(segments)),
            np.ascontiguousarray(np.concatenate([np.zeros((0, 2)), *hulls])),
            np.cumsum([0, *(len(hull) for hull in hulls)]),
            np.ascontiguousarray(level.circles, float).reshape(-1, 3),
        )


@numba.njit(cache=True, nogil=True)
def _add(api, space, owned, count, shape, kind):  # type: ignore[no-untyped-def]
    """Put a shape of a collision type into a space, note it as owned, and return the new count."""
    call_void(api[SHAPE_SET_TYPE], (shape, kind))
    # A filter is passed as group, and categories with the mask in the upper half. What people do to drones, and where
    # they walk, is not the solver's.
    meets = 1 << CRATE if kind == PERSON else _EVERYTHING
    call_void(api[SHAPE_SET_FILTER], (shape, 0, 1 << kind | meets << 32))
    call_address(api[SPACE_ADD_SHAPE], (space, shape))
    owned[count] = shape
    return count + 1


@numba.njit(cache=True, nogil=True)
def build_space(  # type: ignore[no-untyped-def]
    api, segments, vertices, starts, posts, poses, dynamics, radius, people, crates, touched, tally, bodies, shapes,
    walkers, boxes,
):  # fmt: skip
    """Make a world's space and return its address and those of all that it owns, to be freed: shapes, then bodies.

    `bodies` and `shapes` `[drones]`, `walkers` `[people]` and `boxes` `[crates]` receive addresses of bodies and discs;
    `touched` is the address of the callback for drones that touch something, and `tally` `[3, ...]` what it is given
    for walls, drones and crates.
    """
    space = call_address(api[SPACE_NEW], ())
    call_void(api[SPACE_SET_ITERATIONS], (space, _ITERATIONS))
    call_void(api[SPACE_SET_SLOP], (space, _SLOP_M))
    call_void(api[SPACE_SET_BIAS], (space, _BIAS))
    ground = call_address(api[SPACE_STATIC_BODY], (space,))
    moving = 0
    for k in range(len(crates)):
        moving += crates[k, CRATE_MASS] > 0.0
    crowd = 0
    for k in range(len(people)):
        crowd += moving > 0 and people[k, RADIUS] > 0.0  # people meet nothing else in the solver
    owned = np.zeros(len(segments) + len(starts) - 1 + len(posts) + len(bodies) + moving + crowd, np.int64)
    owned_bodies = np.zeros(len(bodies) + moving + crowd, np.int64)
    count = bodies_count = 0
    for drone in range(len(bodies)):
        # Yaw is not the solver's: discs without friction never turn.
        body = call_address(api[BODY_NEW], (dynamics[drone, MASS], np.inf))
        call_void(api[BODY_SET_POSITION], (body, poses[drone, 0], poses[drone, 1]))
        call_address(api[SPACE_ADD_BODY], (space, body))
        disc = call_address(api[CIRCLE_NEW], (body, radius, 0.0, 0.0))
        count = _add(api, space, owned, count, disc, DRONE)
        bodies[drone], shapes[drone] = body, disc
        owned_bodies[bodies_count] = body
        bodies_count += 1
    for k in range(len(segments)):
        ax, ay, bx, by = segments[k, 0], segments[k, 1], segments[k, 2], segments[k, 3]
        edge = call_address(api[SEGMENT_NEW], (ground, ax, ay, bx, by, 0.0))
        call_void(
            api[SEGMENT_SET_NEIGHBORS], (edge, segments[k, 4], segments[k, 5], segments[k, 6], segments[k, 7])
        )  # nothing catches on the joints of a loop
        count = _add(api, space, owned, count, edge, WALL)
    for k in range(len(starts) - 1):
        corners = vertices[starts[k] : starts[k + 1]]
        polygon = call_address(api[POLY_NEW], (ground, len(corners), corners.ctypes.data, 0.0))
        count = _add(api, space, owned, count, polygon, WALL)
    for k in range(len(posts)):
        post = call_address(api[CIRCLE_NEW], (ground, posts[k, 2], posts[k, 0], posts[k, 1]))
        count = _add(api, space, owned, count, post, WALL)
    boxes[:] = 0
    for k in range(len(crates)):
        if crates[k, CRATE_MASS] > 0.0:
            width, depth, mass = 2.0 * crates[k, HALF_WIDTH], 2.0 * crates[k, HALF_DEPTH], crates[k, CRATE_MASS]
            body = call_address(
                api[BODY_NEW], (mass, moment_of_box(mass, crates[k, HALF_WIDTH], crates[k, HALF_DEPTH]))
            )
            call_void(api[BODY_SET_POSITION], (body, crates[k, CRATE_X], crates[k, CRATE_Y]))
            call_void(api[BODY_SET_ANGLE], (body, crates[k, CRATE_YAW]))
            call_address(api[SPACE_ADD_BODY], (space, body))
            box = call_address(api[BOX_NEW], (body, width, depth, 0.0))
            count = _add(api, space, owned, count, box, CRATE)
            boxes[k] = body
            owned_bodies[bodies_count] = body
            bodies_count += 1
    walkers[:] = 0
    for k in range(len(people)):
        if moving > 0 and people[k, RADIUS] > 0.0:
            body = call_address(api[BODY_NEW_KINEMATIC], ())
            call_void(api[BODY_SET_POSITION], (body, people[k, X], people[k, Y]))
            call_address(api[SPACE_ADD_BODY], (space, body))
            disc = call_address(api[CIRCLE_NEW], (body, people[k, RADIUS], 0.0, 0.0))
            count = _add(api, space, owned, count, disc, PERSON)
            walkers[k] = body
            owned_bodies[bodies_count] = body
            bodies_count += 1
    for other in (WALL, DRONE, CRATE):
        handler = call_address(api[SPACE_ADD_HANDLER], (space, DRONE, other))
        store(handler + PRE_SOLVE_OFFSET, touched)
        store(handler + USER_DATA_OFFSET, tally[other - 1].ctypes.data)
    return space, owned, owned_bodies


@numba.njit(cache=True, nogil=True)
def free_space(api, space, owned, owned_bodies):  # type: ignore[no-untyped-def]
    """Give back a space and what it owns."""
    call_void(api[SPACE_FREE], (space,))
    for k in range(len(owned)):
        call_void(api[SHAPE_FREE], (owned[k],))
    for k in range(len(owned_bodies)):
        call_void(api[BODY_FREE], (owned_bodies[k],))
