"""What moves in a level besides the drones: people who walk their loops, and crates that can be pushed.

People give way to nobody. Where one walks into a drone, the drone is pushed aside by a force, never by the solver: a
force yields to walls, so a drone that is pinned is passed through rather than driven into the wall, and the contact
counts all the same. Where a crate lies in the way they wait, so crates are moved by drones alone. Crates stand on
castors: they roll to a stop within seconds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.frames import Pose
from imagine.sim.dynamics import SUBSTEP_S
from imagine.sim.level import Level

CRATE_DAMPING_PER_S = 1.0
"""Speed a rolling crate loses, 1/s: one drone of the Tello class keeps a crate of 2 kg at 0.09 m/s."""
_PUSH_OUT_MPS = 0.5  # how fast a drone that is inside a person is moved out of them
_NEAR_M = 0.5  # further apart than both may move within a substep, at any speed allowed
_TOUCH_M = 0.001  # what counts as touching a person
_LAUNCH_CLEARANCE_M = 0.5  # people start no nearer to a drone
_START_DRAWS = 20

SPEED, RADIUS, ALONG, X, Y, FROM_X, FROM_Y = range(7)  # columns of people
HALF_WIDTH, HALF_DEPTH, CRATE_MASS, CRATE_X, CRATE_Y, CRATE_YAW = range(6)  # columns of crates


@dataclass
class Movers:
    """People and crates of all worlds; rows past a world's own are absent.

    Metres, radians and seconds: `loops` float64 `[worlds, people, waypoints, 2]`; `walks` int64 `[worlds, people,
    2]`: waypoints (0 absent) and the one walked from; `people` float64 `[worlds, people, 7]`: speed, radius, way
    along the leg, place, and place a substep ago; `crates` float64 `[worlds, crates, 6]`: half width and depth,
    mass (0 absent), x, y, yaw. Of these LiDARs see `discs` `[worlds, people, 3]` (x, y, radius; radius 0 absent)
    and `edges` `[worlds, 4 crates, 4]` (x0, y0, x1, y1; all 0 absent).
    """

    loops: NDArray[np.float64]
    walks: NDArray[np.int64]
    people: NDArray[np.float64]
    crates: NDArray[np.float64]
    discs: NDArray[np.float64]
    edges: NDArray[np.float64]

    @classmethod
    def none(cls, worlds: int) -> Movers:
        """Return worlds in which nothing moves by itself."""
        return cls(
            np.zeros((worlds, 0, 0, 2)), np.zeros((worlds, 0, 2), np.int64), np.zeros((worlds, 0, 7)),
            np.zeros((worlds, 0, 6)), np.zeros((worlds, 0, 3)), np.zeros((worlds, 0, 4)),
        )  # fmt: skip

    def make_room(self, level: Level) -> bool:
        """Widen the arrays to what a level needs; tell whether they are others now."""
        people, crates = len(level.people), len(level.crates)
        waypoints = max((len(person.loop) for person in level.people), default=0)
        if people <= self.loops.shape[1] and waypoints <= self.loops.shape[2] and crates <= self.crates.shape[1]:
            return False
        people, waypoints = max(people, self.loops.shape[1]), max(waypoints, self.loops.shape[2])
        crates = max(crates, self.crates.shape[1])
        self.loops = _widened(self.loops, people, waypoints)
        self.walks, self.people = _widened(self.walks, people), _widened(self.people, people)
        self.discs = _widened(self.discs, people)
        self.crates, self.edges = _widened(self.crates, crates), _widened(self.edges, 4 * crates)
        return True

    def place(
        self, world: int, level: Level, rng: np.random.Generator, launches: Sequence[Pose], drone_radius_m: float
    ) -> None:
        """Put a level's crates where they stand, and its people somewhere on their loops.

        Nobody starts in a crate or within half a metre of a drone, unless twenty draws find no such place.
        """
        for array in (self.loops, self.walks, self.people, self.crates, self.discs, self.edges):
            array[world] = 0
        for index, crate in enumerate(level.crates):
            half = (crate.size[0] / 2.0, crate.size[1] / 2.0)
            self.crates[world, index] = (*half, crate.mass_kg, *crate.center, math.radians(crate.yaw_deg))
        for index, person in enumerate(level.people):
            count = len(person.loop)
            self.loops[world, index, :count] = person.loop
            self.people[world, index, SPEED], self.people[world, index, RADIUS] = person.speed_mps, person.radius
            self.walks[world, index, 0] = count
            for share in rng.random(_START_DRAWS):
                start_walk(world, index, self.loops, self.walks, self.people, float(share))
                x, y = self.people[world, index, X], self.people[world, index, Y]
                room = drone_radius_m + person.radius + _LAUNCH_CLEARANCE_M
                clear_of_drones = all(math.hypot(x - p.x, y - p.y) >= room for p in launches)
                if clear_of_drones and not _crate_within(world, self.crates, x, y, person.radius):
                    break
        show_movers(world, self.people, self.crates, self.discs, self.edges)


def _widened(array: NDArray[np.generic], *sizes: int) -> NDArray:  # type: ignore[type-arg]
    """Return a copy with the axes after the first grown to `sizes`, filled with zeros."""
    grown = np.zeros((array.shape[0], *sizes, *array.shape[1 + len(sizes) :]), array.dtype)
    grown[tuple(slice(size) for size in array.shape)] = array
    return grown


# Kernels get whole arrays and indices: each slice made in an inner loop would count references, with a bus lock.


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _leg(world, k, loops, walks):  # type: ignore[no-untyped-def]
    """Return where the leg that person `k` walks begins, its direction and its length."""
    leg = walks[world, k, 1]
    following = leg + 1 if leg + 1 < walks[world, k, 0] else 0
    x, y = loops[world, k, leg, 0], loops[world, k, leg, 1]
    dx, dy = loops[world, k, following, 0] - x, loops[world, k, following, 1] - y
    length = math.sqrt(dx * dx + dy * dy)
    if length == 0.0:
        return x, y, 0.0, 0.0, 0.0
    return x, y, dx / length, dy / length, length


@numba.njit(cache=True, nogil=True, error_model="numpy")
def start_walk(world, k, loops, walks, people, share):  # type: ignore[no-untyped-def]
    """Put a person on their loop, after a share of its length."""
    total = 0.0
    for leg in range(walks[world, k, 0]):
        walks[world, k, 1] = leg
        total += _leg(world, k, loops, walks)[4]
    walks[world, k, 1], people[world, k, ALONG] = 0, 0.0
    _walk(world, k, loops, walks, people, share * total)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _walk(world, k, loops, walks, people, way):  # type: ignore[no-untyped-def]
    """Bring a person `way` metres further along their loop."""
    along = people[world, k, ALONG] + way
    x, y, ux, uy, length = _leg(world, k, loops, walks)
    for _ in range(2 * walks[world, k, 0]):  # a step is shorter than a loop worth walking; this ends on others, too
        if along < length:
            break
        along -= length
        walks[world, k, 1] = walks[world, k, 1] + 1 if walks[world, k, 1] + 1 < walks[world, k, 0] else 0
        x, y, ux, uy, length = _leg(world, k, loops, walks)
    people[world, k, ALONG] = along
    people[world, k, X], people[world, k, Y] = x + ux * along, y + uy * along


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _distance_to_crate(world, k, crates, x, y):  # type: ignore[no-untyped-def]
    """Return the distance from a point to a crate, 0 inside."""
    c, s = math.cos(crates[world, k, CRATE_YAW]), math.sin(crates[world, k, CRATE_YAW])
    dx, dy = x - crates[world, k, CRATE_X], y - crates[world, k, CRATE_Y]
    beside = max(abs(c * dx + s * dy) - crates[world, k, HALF_WIDTH], 0.0)
    before = max(abs(c * dy - s * dx) - crates[world, k, HALF_DEPTH], 0.0)
    return math.sqrt(beside * beside + before * before)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _crate_within(world, crates, x, y, radius):  # type: ignore[no-untyped-def]
    within = False
    for k in range(crates.shape[1]):
        within |= crates[world, k, CRATE_MASS] > 0.0 and _distance_to_crate(world, k, crates, x, y) < radius
    return within


@numba.njit(cache=True, nogil=True, error_model="numpy")
def walk_people(world, loops, walks, people, crates):  # type: ignore[no-untyped-def]
    """Move a world's people on by one substep, but not into a crate."""
    for k in range(people.shape[1]):
        people[world, k, FROM_X], people[world, k, FROM_Y] = people[world, k, X], people[world, k, Y]
        if walks[world, k, 0] == 0:
            continue
        along, leg, x, y = people[world, k, ALONG], walks[world, k, 1], people[world, k, X], people[world, k, Y]
        _walk(world, k, loops, walks, people, people[world, k, SPEED] * SUBSTEP_S)
        for c in range(crates.shape[1]):
            if crates[world, c, CRATE_MASS] == 0.0:
                continue
            distance = _distance_to_crate(world, c, crates, people[world, k, X], people[world, k, Y])
            if distance < people[world, k, RADIUS] and distance <= _distance_to_crate(world, c, crates, x, y):
                people[world, k, ALONG], walks[world, k, 1] = along, leg
                people[world, k, X], people[world, k, Y] = x, y
                break


@numba.njit(cache=True, nogil=True, error_model="numpy")
def pushed(world, x, y, vx, vy, ax, ay, people, radius):  # type: ignore[no-untyped-def]
    """Return a drone's acceleration so that it does not go into a person, and is moved out of one.

    `x, y` is where the drone will be after this substep, as the people are already; `vx, vy` its velocity now.
    """
    for k in range(people.shape[1]):
        if people[world, k, RADIUS] == 0.0:
            continue
        dx, dy = x - people[world, k, X], y - people[world, k, Y]
        distance = math.sqrt(dx * dx + dy * dy)
        gap = distance - people[world, k, RADIUS] - radius
        if gap > _NEAR_M or distance == 0.0:
            continue  # out of reach; or right in the middle, where every way is out
        nx, ny = dx / distance, dy / distance
        wx = (people[world, k, X] - people[world, k, FROM_X]) / SUBSTEP_S
        wy = (people[world, k, Y] - people[world, k, FROM_Y]) / SUBSTEP_S
        parting = (vx + ax * SUBSTEP_S - wx) * nx + (vy + ay * SUBSTEP_S - wy) * ny
        least = -gap / SUBSTEP_S if gap > 0.0 else min(-gap / SUBSTEP_S, _PUSH_OUT_MPS)
        if parting < least:
            ax += (least - parting) / SUBSTEP_S * nx
            ay += (least - parting) / SUBSTEP_S * ny
    return ax, ay


@numba.njit(cache=True, nogil=True, error_model="numpy")
def touches_person(world, x, y, people, radius):  # type: ignore[no-untyped-def]
    """Tell whether a drone at (x, y) touches somebody."""
    touches = False
    for k in range(people.shape[1]):
        reach = people[world, k, RADIUS] + radius + _TOUCH_M
        dx, dy = x - people[world, k, X], y - people[world, k, Y]
        touches |= people[world, k, RADIUS] > 0.0 and dx * dx + dy * dy < reach * reach
    return touches


@numba.njit(cache=True, nogil=True)
def moment_of_box(mass, half_width, half_depth):  # type: ignore[no-untyped-def]
    """Return a full box's moment of inertia about its centre, kg m²."""
    return mass * (half_width * half_width + half_depth * half_depth) / 3.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def show_movers(world, people, crates, discs, edges):  # type: ignore[no-untyped-def]
    """Write what LiDARs see of a world's people and crates into `discs` and `edges`."""
    for k in range(people.shape[1]):
        discs[world, k, 0], discs[world, k, 1] = people[world, k, X], people[world, k, Y]
        discs[world, k, 2] = people[world, k, RADIUS]
    for k in range(crates.shape[1]):
        if crates[world, k, CRATE_MASS] == 0.0:
            continue
        c, s = math.cos(crates[world, k, CRATE_YAW]), math.sin(crates[world, k, CRATE_YAW])
        for corner in range(4):  # counter-clockwise; each begins one edge and ends the one before
            across = crates[world, k, HALF_WIDTH] if corner in (1, 2) else -crates[world, k, HALF_WIDTH]
            along = crates[world, k, HALF_DEPTH] if corner >= 2 else -crates[world, k, HALF_DEPTH]
            x = crates[world, k, CRATE_X] + c * across - s * along
            y = crates[world, k, CRATE_Y] + s * across + c * along
            begun, ended = 4 * k + corner, 4 * k + (corner + 3) % 4
            edges[world, begun, 0], edges[world, begun, 1] = x, y
            edges[world, ended, 2], edges[world, ended, 3] = x, y
