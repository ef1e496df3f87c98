"""Stepping worlds: forces, the solver, people and crates, and the counting of contacts, in one kernel without a lock.

Every world has a space of its own at its own origin, so it flies bit for bit as it would alone.
"""

from __future__ import annotations

import math

import numba
from numba.core import types

from imagine.sim.chipmunk import (
    ARBITER_BODIES,
    BODY_ANGLE,
    BODY_ANGULAR_VELOCITY,
    BODY_POSITION,
    BODY_SET_FORCE,
    BODY_SET_POSITION,
    BODY_SET_TORQUE,
    BODY_SET_VELOCITY,
    BODY_VELOCITY,
    SPACE_ADD_BODY,
    SPACE_ADD_SHAPE,
    SPACE_REMOVE_BODY,
    SPACE_REMOVE_SHAPE,
    SPACE_STEP,
    call_address,
    call_double,
    call_vector,
    call_void,
    load,
    store,
)
from imagine.sim.dynamics import (
    DELAY,
    MASS,
    SUBSTEP_S,
    SUBSTEPS,
    YAW_BLEND,
    acceleration_for,
    blow,
    delayed,
    keep_setpoint,
)
from imagine.sim.movers import (
    CRATE_DAMPING_PER_S,
    CRATE_MASS,
    CRATE_X,
    CRATE_Y,
    CRATE_YAW,
    HALF_DEPTH,
    HALF_WIDTH,
    X,
    Y,
    moment_of_box,
    pushed,
    show_movers,
    touches_person,
    walk_people,
)

WALLS, DRONES, MOVERS = range(3)
"""What contacts are counted of: rows of the counts and of the tally."""
APART_SUBSTEPS = 10
"""A touch this many substeps (0.2 s) after the last one of its kind belongs to the same contact: who slides along a
wall of many edges, or bounces, has met it once."""
NEVER = -1_000_000

# A row of the tally is what a callback is given: addresses, and what it cannot be told otherwise.
_BODIES_FUNCTION, _BODY_A, _BODY_B, _CLOCK, _COUNT, _BODIES, _COUNTS, _LAST = range(8)
TALLY_COLUMNS = 8
_WORD = 8  # bytes

_CRATE_LOSS = (1.0 - math.exp(-CRATE_DAMPING_PER_S * SUBSTEP_S)) / SUBSTEP_S


@numba.njit(cache=True, nogil=True)
def _touch(drone, clock, counts, last):  # type: ignore[no-untyped-def]
    """Count a drone's touch, if it is the first for a while; `counts` and `last` are addresses of rows."""
    if clock - load(last + _WORD * drone) > APART_SUBSTEPS:
        store(counts + _WORD * drone, load(counts + _WORD * drone) + 1)
    store(last + _WORD * drone, clock)


@numba.cfunc(types.void(types.int64, types.int64, types.int64), cache=True)
def touched(arbiter, space, row):  # type: ignore[no-untyped-def]
    """Take note of two bodies that touch: the solver calls this in every substep that they do."""
    call_void(load(row + _WORD * _BODIES_FUNCTION), (arbiter, row + _WORD * _BODY_A, row + _WORD * _BODY_B))
    a, b = load(row + _WORD * _BODY_A), load(row + _WORD * _BODY_B)
    bodies = load(row + _WORD * _BODIES)
    for drone in range(load(row + _WORD * _COUNT)):
        body = load(bodies + _WORD * drone)
        if body in (a, b):
            _touch(drone, load(row + _WORD * _CLOCK), load(row + _WORD * _COUNTS), load(row + _WORD * _LAST))


@numba.njit(cache=True, nogil=True)
def prepare_tally(api, world, tally, bodies, counts, last_touch):  # type: ignore[no-untyped-def]
    """Fill the rows of a world's tally, and forget what its drones touched; arrays as `step_worlds` takes them."""
    for kind in range(3):
        row = tally[world, kind]
        row[_BODIES_FUNCTION], row[_CLOCK], row[_COUNT] = api[ARBITER_BODIES], 0, bodies.shape[1]
        row[_BODIES] = bodies[world].ctypes.data
        row[_COUNTS], row[_LAST] = counts[kind, world].ctypes.data, last_touch[kind, world].ctypes.data
        counts[kind, world, :] = 0
        last_touch[kind, world, :] = NEVER


@numba.njit(cache=True, nogil=True)
def fastest_mps(radius):  # type: ignore[no-untyped-def]
    """Return how fast a disc of this radius (m) may be so that no substep carries its centre past what it touches."""
    return 0.75 * radius / SUBSTEP_S


@numba.njit(cache=True, nogil=True, error_model="numpy")
def step_worlds(  # type: ignore[no-untyped-def]
    first, last, setpoints, api, spaces, bodies, shapes, tally, counts, last_touch, contacts, ages, keys, poses,
    velocity, alive, present, dynamics, wind, history, limits, loops, walks, people, walkers, crates, boxes, discs,
    edges,
):  # fmt: skip
    """Fly worlds first to last one tick, with body setpoints `[worlds, drones, 3]` (forward, left, yaw rate).

    The arrays are a Twin's `kernel_args()`. Setpoints must be finite. Touches neither the interpreter nor other
    worlds, so threads may share the worlds out.
    """
    speed, fastest_yaw, radius = limits
    drones = poses.shape[1]
    for world in range(first, last):
        age = ages[world]
        blow(world, wind, dynamics, keys[world], age)
        for drone in range(drones):
            keep_setpoint(world, drone, history, age, setpoints, speed, fastest_yaw)
            if alive[world, drone] != present[world, drone]:
                _fall_or_rise(api, spaces[world], bodies[world, drone], shapes[world, drone], alive[world, drone])
                present[world, drone] = alive[world, drone]
                for axis in range(3):
                    velocity[world, drone, axis] = 0.0
        crowded, cluttered = False, False
        for k in range(people.shape[1]):
            crowded |= walks[world, k, 0] > 0
        for k in range(crates.shape[1]):
            cluttered |= boxes[world, k] != 0
        for substep in range(SUBSTEPS):
            clock = age * SUBSTEPS + substep
            for kind in range(3):
                tally[world, kind, _CLOCK] = clock
            if crowded:
                walk_people(world, loops, walks, people, crates)
            for drone in range(drones):
                if not alive[world, drone]:
                    continue
                body, mass = bodies[world, drone], dynamics[world, drone, MASS]
                forward, left, rate = delayed(world, drone, history, age, substep, dynamics[world, drone, DELAY])
                vx, vy = velocity[world, drone, 0], velocity[world, drone, 1]
                ax, ay = acceleration_for(world, drone, forward, left, poses[world, drone, 2], vx, vy, wind, dynamics)
                if crowded:
                    x, y = call_vector(api[BODY_POSITION], (body,))
                    ax, ay = pushed(world, x + vx * SUBSTEP_S, y + vy * SUBSTEP_S, vx, vy, ax, ay, people, radius)
                # Forces, not velocities: the solver then stops what pushes into a wall before positions move.
                call_void(api[BODY_SET_FORCE], (body, mass * ax, mass * ay))
                velocity[world, drone, 2] += (rate - velocity[world, drone, 2]) * dynamics[world, drone, YAW_BLEND]
                poses[world, drone, 2] += velocity[world, drone, 2] * SUBSTEP_S
            if cluttered:
                _roll(api, world, crates, boxes)
                for k in range(people.shape[1]):
                    if walkers[world, k] != 0:
                        call_void(api[BODY_SET_POSITION], (walkers[world, k], people[world, k, X], people[world, k, Y]))
            call_void(api[SPACE_STEP], (spaces[world], SUBSTEP_S))
            for drone in range(drones):
                if not alive[world, drone]:
                    continue
                vx, vy = call_vector(api[BODY_VELOCITY], (bodies[world, drone],))
                share = fastest_mps(radius) / max(math.sqrt(vx * vx + vy * vy), 1e-9)
                if share < 1.0:  # gusts and shoves: any faster, and a substep could carry it through a wall
                    vx, vy = vx * share, vy * share
                    call_void(api[BODY_SET_VELOCITY], (bodies[world, drone], vx, vy))
                velocity[world, drone, 0], velocity[world, drone, 1] = vx, vy
                if crowded:
                    x, y = call_vector(api[BODY_POSITION], (bodies[world, drone],))
                    if touches_person(world, x, y, people, radius):
                        if clock - last_touch[MOVERS, world, drone] > APART_SUBSTEPS:
                            counts[MOVERS, world, drone] += 1
                        last_touch[MOVERS, world, drone] = clock
            if cluttered:
                _read_crates(api, world, crates, boxes)
        for drone in range(drones):
            if alive[world, drone]:
                poses[world, drone, 0], poses[world, drone, 1] = call_vector(
                    api[BODY_POSITION], (bodies[world, drone],)
                )
                poses[world, drone, 2] = (poses[world, drone, 2] + math.pi) % (2.0 * math.pi) - math.pi
            contacts[world, drone] = counts[WALLS, world, drone] + counts[DRONES, world, drone]
            contacts[world, drone] += counts[MOVERS, world, drone]
        if crowded or cluttered:
            show_movers(world, people, crates, discs, edges)
        ages[world] = age + 1


@numba.njit(cache=True, nogil=True)
def _fall_or_rise(api, space, body, shape, alive):  # type: ignore[no-untyped-def]
    """Take a drone that fell out of the space, or put one that is up again back where it fell."""
    if alive:
        call_void(api[BODY_SET_VELOCITY], (body, 0.0, 0.0))
        call_address(api[SPACE_ADD_BODY], (space, body))
        call_address(api[SPACE_ADD_SHAPE], (space, shape))
    else:
        call_void(api[SPACE_REMOVE_SHAPE], (space, shape))
        call_void(api[SPACE_REMOVE_BODY], (space, body))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _roll(api, world, crates, boxes):  # type: ignore[no-untyped-def]
    """Brake a world's crates, in speed and turning."""
    for k in range(crates.shape[1]):
        box = boxes[world, k]
        if box == 0:
            continue
        mass = crates[world, k, CRATE_MASS]
        vx, vy = call_vector(api[BODY_VELOCITY], (box,))
        call_void(api[BODY_SET_FORCE], (box, -mass * _CRATE_LOSS * vx, -mass * _CRATE_LOSS * vy))
        turning = call_double(api[BODY_ANGULAR_VELOCITY], (box,))
        moment = moment_of_box(mass, crates[world, k, HALF_WIDTH], crates[world, k, HALF_DEPTH])
        call_void(api[BODY_SET_TORQUE], (box, -moment * _CRATE_LOSS * turning))


@numba.njit(cache=True, nogil=True)
def _read_crates(api, world, crates, boxes):  # type: ignore[no-untyped-def]
    """Take a world's crates' places from the solver."""
    for k in range(crates.shape[1]):
        if boxes[world, k] != 0:
            crates[world, k, CRATE_X], crates[world, k, CRATE_Y] = call_vector(api[BODY_POSITION], (boxes[world, k],))
            crates[world, k, CRATE_YAW] = call_double(api[BODY_ANGLE], (boxes[world, k],))
