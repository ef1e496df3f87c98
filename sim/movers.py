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

SPEED, RADIUS, ALONG, X, Y = range(5)  # columns of people
HALF_WIDTH, HALF_DEPTH, CRATE_MASS, CRATE_X, CRATE_Y, CRATE_YAW = range(6)  # columns of crates


@dataclass
class Movers:
    """People and crates of all worlds; rows past a world's own are absent.

    `loops` float64 `[worlds, people, waypoints, 2]`, m; `walks` int64 `[worlds, people, 2]`: waypoints (0 absent) and
    the one walked from; `people` float64 `[worlds, people, 5]`: speed, radius, way along the leg, x, y; `crates`
    float64 `[worlds, crates, 6]`: half width and depth, mass (0 absent), x, y, yaw. Of these LiDARs see `discs`
    `[worlds, people, 3]` (x, y, radius; radius 0 absent) and `edges` `[worlds, 4 crates, 4]` (x0, y0, x1, y1; all 0
    absent).
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
            np.zeros((worlds, 0, 0, 2)), np.zeros((worlds, 0, 2), np.int64), np.zeros((worlds, 0, 5)),
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
                _start(self.loops[world, index], self.walks[world, index], self.people[world, index], share)
                x, y = self.people[world, index, X:]
                room = drone_radius_m + person.radius + _LAUNCH_CLEARANCE_M
                clear_of_drones = all(math.hypot(x - p.x, y - p.y) >= room for p in launches)
                if clear_of_drones and not _crate_within(self.crates[world], x, y, person.radius):
                    break
        show_movers(self.people[world], self.crates[world], self.discs[world], self.edges[world])


def _widened(array: NDArray[np.generic], *sizes: int) -> NDArray:  # type: ignore[type-arg]
    """Return a copy with the axes after the first grown to `sizes`, filled with zeros."""
    grown = np.zeros((array.shape[0], *sizes, *array.shape[1 + len(sizes) :]), array.dtype)
    grown[tuple(slice(size) for size in array.shape)] = array
    return grown


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _leg(loop, walk):  # type: ignore[no-untyped-def]
    """Return where the leg that is walked begins, its direction and its length."""
    following = walk[1] + 1 if walk[1] + 1 < walk[0] else 0
    x, y = loop[walk[1], 0], loop[walk[1], 1]
    dx, dy = loop[following, 0] - x, loop[following, 1] - y
    length = math.sqrt(dx * dx + dy * dy)
    if length == 0.0:
        return x, y, 0.0, 0.0, 0.0
    return x, y, dx / length, dy / length, length


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _start(loop, walk, person, share):  # type: ignore[no-untyped-def]
    """Put a person on their loop, after a share of its length."""
    total = 0.0
    for leg in range(walk[0]):
        walk[1] = leg
        total += _leg(loop, walk)[4]
    walk[1], person[ALONG] = 0, 0.0
    _walk(loop, walk, person, share * total)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _walk(loop, walk, person, way):  # type: ignore[no-untyped-def]
    """Bring a person `way` metres further along their loop."""
    person[ALONG] += way
    x, y, ux, uy, length = _leg(loop, walk)
    for _ in range(2 * walk[0]):  # a step is shorter than any loop worth walking; this ends on all others, too
        if person[ALONG] < length:
            break
        person[ALONG] -= length
        walk[1] = walk[1] + 1 if walk[1] + 1 < walk[0] else 0
        x, y, ux, uy, length = _leg(loop, walk)
    person[X], person[Y] = x + ux * person[ALONG], y + uy * person[ALONG]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _distance_to_crate(crate, x, y):  # type: ignore[no-untyped-def]
    """Return the distance from a point to a crate, 0 inside."""
    c, s = math.cos(crate[CRATE_YAW]), math.sin(crate[CRATE_YAW])
    dx, dy = x - crate[CRATE_X], y - crate[CRATE_Y]
    beside = max(abs(c * dx + s * dy) - crate[HALF_WIDTH], 0.0)
    before = max(abs(c * dy - s * dx) - crate[HALF_DEPTH], 0.0)
    return math.sqrt(beside * beside + before * before)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _crate_within(crates, x, y, radius):  # type: ignore[no-untyped-def]
    within = False
    for k in range(len(crates)):
        within |= crates[k, CRATE_MASS] > 0.0 and _distance_to_crate(crates[k], x, y) < radius
    return within


@numba.njit(cache=True, nogil=True, error_model="numpy")
def walk_people(loops, walks, people, crates):  # type: ignore[no-untyped-def]
    """Move a world's people on by one substep, but not into a crate."""
    for k in range(len(people)):
        if walks[k, 0] == 0:
            continue
        way = people[k, SPEED] * SUBSTEP_S
        along, leg, x, y = people[k, ALONG], walks[k, 1], people[k, X], people[k, Y]
        _walk(loops[k], walks[k], people[k], way)
        for c in range(len(crates)):
            if crates[c, CRATE_MASS] > 0.0:
                distance = _distance_to_crate(crates[c], people[k, X], people[k, Y])
                if distance < people[k, RADIUS] and distance <= _distance_to_crate(crates[c], x, y):
                    people[k, ALONG], walks[k, 1], people[k, X], people[k, Y] = along, leg, x, y
                    break


@numba.njit(cache=True, nogil=True, error_model="numpy")
def pushed(x, y, vx, vy, ax, ay, people, before, radius):  # type: ignore[no-untyped-def]
    """Return a drone's acceleration so that it does not go into a person, and is moved out of one.

    `x, y` is where the drone will be after this substep, `vx, vy` its velocity now, `before` `[people, 2]` where the
    people, who are where they will be, come from.
    """
    for k in range(len(people)):
        if people[k, RADIUS] == 0.0:
            continue
        dx, dy = x - people[k, X], y - people[k, Y]
        distance = math.sqrt(dx * dx + dy * dy)
        gap = distance - people[k, RADIUS] - radius
        if gap > _NEAR_M or distance == 0.0:
            continue  # out of reach; or right in the middle, where every way is out
        nx, ny = dx / distance, dy / distance
        wx, wy = (people[k, X] - before[k, 0]) / SUBSTEP_S, (people[k, Y] - before[k, 1]) / SUBSTEP_S
        parting = (vx + ax * SUBSTEP_S - wx) * nx + (vy + ay * SUBSTEP_S - wy) * ny
        least = -gap / SUBSTEP_S if gap > 0.0 else min(-gap / SUBSTEP_S, _PUSH_OUT_MPS)
        if parting < least:
            ax += (least - parting) / SUBSTEP_S * nx
            ay += (least - parting) / SUBSTEP_S * ny
    return ax, ay


@numba.njit(cache=True, nogil=True, error_model="numpy")
def touches_person(x, y, people, radius):  # type: ignore[no-untyped-def]
    """Tell whether a drone at (x, y) touches somebody."""
    for k in range(len(people)):
        reach = people[k, RADIUS] + radius + _TOUCH_M
        dx, dy = x - people[k, X], y - people[k, Y]
        if people[k, RADIUS] > 0.0 and dx * dx + dy * dy < reach * reach:
            return True
    return False


@numba.njit(cache=True, nogil=True, error_model="numpy")
def show_movers(people, crates, discs, edges):  # type: ignore[no-untyped-def]
    """Write what LiDARs see of a world's people and crates into `discs` and `edges`."""
    for k in range(len(people)):
        discs[k, 0], discs[k, 1], discs[k, 2] = people[k, X], people[k, Y], people[k, RADIUS]
    corners = np.empty((4, 2))
    for k in range(len(crates)):
        if crates[k, CRATE_MASS] == 0.0:
            continue
        c, s = math.cos(crates[k, CRATE_YAW]), math.sin(crates[k, CRATE_YAW])
        for corner in range(4):
            across = crates[k, HALF_WIDTH] if corner in (1, 2) else -crates[k, HALF_WIDTH]
            along = crates[k, HALF_DEPTH] if corner >= 2 else -crates[k, HALF_DEPTH]
            corners[corner, 0] = crates[k, CRATE_X] + c * across - s * along
            corners[corner, 1] = crates[k, CRATE_Y] + s * across + c * along
        for corner in range(4):
            following = (corner + 1) % 4
            edges[4 * k + corner, 0], edges[4 * k + corner, 1] = corners[corner, 0], corners[corner, 1]
            edges[4 * k + corner, 2], edges[4 * k + corner, 3] = corners[following, 0], corners[following, 1]
