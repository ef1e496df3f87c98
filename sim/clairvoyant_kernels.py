"""The inner loops of `clairvoyant`: what a plan of waypoints sees by when, and the search for a quick one."""

from __future__ import annotations

import math

import numba
import numpy as np

from imagine.core.raster import CELL
from imagine.sim.dynamics import TICK_S
from imagine.sim.rays import cast_rays

TICKS_PER_S = round(1.0 / TICK_S)
_NOWHERE = 1e9
_STEP_M = 0.05  # along a beam, half a cell


@numba.njit(cache=True, nogil=True)
def mark_seen(seen, ids, points, segments, circles, reach_m, beams, column0, row0):  # type: ignore[no-untyped-def]
    """Set in `seen` (uint64 `[points, words]`) the bits of the cells each of `points` `[n, 2]` sees within `reach_m`.

    `ids` int32 `[rows, columns]` numbers the cells that count, from cell (column0, row0); others are below 0.
    """
    ranges = np.empty(beams)
    rows, columns = ids.shape
    for k in range(len(points)):
        x, y = points[k]
        cast_rays(ranges, segments, circles, x, y, 0.0, 2.0 * math.pi / beams, reach_m)
        for beam in range(beams):
            angle = 2.0 * math.pi * beam / beams
            cosine, sine = math.cos(angle), math.sin(angle)
            for step in range(int(min(ranges[beam], reach_m) / _STEP_M)):
                along = step * _STEP_M
                column = math.floor((x + along * cosine) / CELL) - column0
                row = math.floor((y + along * sine) / CELL) - row0
                if 0 <= row < rows and 0 <= column < columns and ids[row, column] >= 0:
                    seen[k, ids[row, column] >> 6] |= np.uint64(1) << np.uint64(ids[row, column] & 63)


@numba.njit(cache=True, nogil=True)
def bits(words):  # type: ignore[no-untyped-def]
    """Return how many bits of uint64 `words` are set."""
    count = 0
    for word in words:
        count += _ones(word)
    return count


@numba.njit(cache=True, nogil=True)
def _ones(word):  # type: ignore[no-untyped-def]
    count = 0
    while word:
        word &= word - np.uint64(1)
        count += 1
    return count


@numba.njit(cache=True, nogil=True)
def covered_after(way, lengths, starts, nodes, far, before, seen, needed, speed, most_ticks, passed):  # type: ignore[no-untyped-def]
    """Return the ticks until `needed` cells are seen by drones that fly through their waypoints by the shortest ways.

    `way` `[drones, most]` are waypoints, the first `lengths` `[drones]` count; `nodes` where they are, `far` and
    `before` `[waypoints, points]` the ways to each. Beyond `most_ticks` by as much as is missing. `passed` is scratch.
    """
    passed[:] = -1
    for drone in range(len(starts)):
        at, metres = starts[drone], 0.0
        for k in range(lengths[drone]):
            waypoint = way[drone, k]
            if not far[waypoint, at] < _NOWHERE:
                return 10.0 * most_ticks
            while at != nodes[waypoint]:
                onward = before[waypoint, at]
                metres += far[waypoint, at] - far[waypoint, onward]
                at = onward
                tick = math.ceil(metres / speed * TICKS_PER_S)
                if tick <= most_ticks:
                    passed[drone, tick] = at
    known = np.zeros(seen.shape[1], np.uint64)
    for drone in range(len(starts)):
        known |= seen[starts[drone]]
    count = bits(known)
    for tick in range(most_ticks + 1):
        for drone in range(len(starts)):
            at = passed[drone, tick]
            if at >= 0:
                for word in range(len(known)):
                    new = seen[at, word] & ~known[word]
                    if new:
                        known[word] |= new
                        count += _ones(new)
        if count >= needed:
            return float(tick)
    return most_ticks * (1.0 + (needed - count) / needed)


@numba.njit(cache=True, nogil=True)
def quickest(starts, nodes, far, before, seen, needed, speed, most_ticks, tries, most_waypoints, generator):  # type: ignore[no-untyped-def]
    """Return the fewest ticks that simulated annealing finds, over drones' waypoints: which, whose, in what order."""
    drones, choices = len(starts), len(nodes)
    way, lengths = np.zeros((drones, most_waypoints), np.int64), np.zeros(drones, np.int64)
    passed = np.empty((drones, most_ticks + 1), np.int64)
    now = best = covered_after(way, lengths, starts, nodes, far, before, seen, needed, speed, most_ticks, passed)
    for k in range(tries):
        heat = 12.0 * (1.0 - k / tries) + 0.05
        kept_way, kept_lengths = way.copy(), lengths.copy()
        if not _change(way, lengths, nodes, far, choices, generator):
            continue
        new = covered_after(way, lengths, starts, nodes, far, before, seen, needed, speed, most_ticks, passed)
        if new <= now or generator.random() < math.exp((now - new) / heat):
            now = new
            best = min(best, now)
        else:
            way, lengths = kept_way, kept_lengths
    return best


@numba.njit(cache=True, nogil=True)
def _change(way, lengths, nodes, far, choices, generator):  # type: ignore[no-untyped-def]
    """Change the plan by chance: a waypoint is put in, left out, moved, exchanged, or given to another drone."""
    drones, most = way.shape
    drone, kind = generator.integers(0, drones), generator.integers(0, 5)
    if kind == 0 or lengths[drone] == 0:
        return _put(way, lengths, drone, generator.integers(0, choices), most, generator)
    place = generator.integers(0, lengths[drone])
    if kind == 1:
        _take(way, lengths, drone, place)
    elif kind == 2:
        for _ in range(6):
            other = generator.integers(0, choices)
            if far[way[drone, place], nodes[other]] < 1.6:
                way[drone, place] = other
                return True
        return False
    elif kind == 3:
        other = generator.integers(0, lengths[drone])
        way[drone, place], way[drone, other] = way[drone, other], way[drone, place]
    else:
        to = generator.integers(0, drones)
        if to == drone or lengths[to] >= most:
            return False
        waypoint = way[drone, place]
        _take(way, lengths, drone, place)
        return _put(way, lengths, to, waypoint, most, generator)
    return True


@numba.njit(cache=True, nogil=True)
def _put(way, lengths, drone, waypoint, most, generator):  # type: ignore[no-untyped-def]
    if lengths[drone] >= most:
        return False
    place = generator.integers(0, lengths[drone] + 1)
    for k in range(lengths[drone], place, -1):
        way[drone, k] = way[drone, k - 1]
    way[drone, place] = waypoint
    lengths[drone] += 1
    return True


@numba.njit(cache=True, nogil=True)
def _take(way, lengths, drone, place):  # type: ignore[no-untyped-def]
    for k in range(place, lengths[drone] - 1):
        way[drone, k] = way[drone, k + 1]
    lengths[drone] -= 1
