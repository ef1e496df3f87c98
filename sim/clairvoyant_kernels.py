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
_STEP_M = 0.05  # along a beam or a flight, half a cell
_AHEAD_M, _NEXT_M = 1.2, 0.35


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
def covered_after(  # type: ignore[no-untyped-def]
    way, lengths, starts, nodes, far, before, seen, known, needed, speed, most_ticks, per_metre, passed, scratch
):
    """Return the ticks until `needed` cells are seen by drones that fly through their waypoints by the shortest ways.

    `way` `[drones, most]` are waypoints, the first `lengths` `[drones]` count; `nodes` where they are, `far` and
    `before` `[waypoints, points]` the ways to each; `known` uint64 `[words]` what is seen already. Beyond `most_ticks`
    by as much as is missing; every metre of the plan costs `per_metre` ticks more. `passed` `[drones, most_ticks + 1]`
    and `scratch` `[words]` are worked with.
    """
    passed[:] = -1
    last, total = 0, 0.0
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
                    last = max(last, tick)
        total += metres
    scratch[:] = known
    for drone in range(len(starts)):
        scratch |= seen[starts[drone]]
    count = bits(scratch)
    for tick in range(last + 1):
        for drone in range(len(starts)):
            at = passed[drone, tick]
            if at >= 0:
                for word in range(len(scratch)):
                    new = seen[at, word] & ~scratch[word]
                    if new:
                        scratch[word] |= new
                        count += _ones(new)
        if count >= needed:
            return tick + per_metre * total
    return most_ticks * (1.0 + (needed - count) / needed) + per_metre * total


@numba.njit(cache=True, nogil=True)
def improve(  # type: ignore[no-untyped-def]
    way, lengths, starts, nodes, far, before, seen, known, needed, speed, most_ticks, tries, heat, per_metre, generator
):
    """Improve a plan (`way`, `lengths`, as in `covered_after`) by simulated annealing; return the ticks that it takes.

    What is changed are drones' waypoints: which, whose, in what order. `heat` in ticks is what annealing begins with;
    the best plan of all is what remains.
    """
    passed, scratch = np.empty((len(starts), most_ticks + 1), np.int64), np.empty_like(known)
    now = best = covered_after(
        way, lengths, starts, nodes, far, before, seen, known, needed, speed, most_ticks, per_metre, passed, scratch
    )
    best_way, best_lengths = way.copy(), lengths.copy()
    kept_way, kept_lengths = way.copy(), lengths.copy()
    for k in range(tries):
        warmth = heat * (1.0 - k / tries) + 0.05
        kept_way[:], kept_lengths[:] = way, lengths
        if not _change(way, lengths, nodes, far, len(nodes), generator):
            continue
        new = covered_after(
            way, lengths, starts, nodes, far, before, seen, known, needed, speed, most_ticks, per_metre, passed, scratch
        )
        if new <= now or generator.random() < math.exp((now - new) / warmth):
            now = new
            if now < best:
                best = now
                best_way[:], best_lengths[:] = way, lengths
        else:
            way[:], lengths[:] = kept_way, kept_lengths
    way[:], lengths[:] = best_way, best_lengths
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


@numba.njit(cache=True, nogil=True)
def path_through(way, length, start, nodes, before):  # type: ignore[no-untyped-def]
    """Return the points of the shortest way from point `start` through a drone's waypoints, int64 `[n]`."""
    at, path = start, [start]
    for k in range(length):
        while at != nodes[way[k]]:
            at = before[way[k], at]
            if at < 0:
                return np.array(path)
            path.append(at)
    return np.array(path)


@numba.njit(cache=True, nogil=True)
def ahead(path, points, x, y, clear, column0, row0):  # type: ignore[no-untyped-def]
    """Return the farthest point of a path that (x, y) can fly to straight, at most `_AHEAD_M` along the path.

    Straight is through `clear` cells, bool `[rows, columns]` from cell (column0, row0). Where nothing is, in a door, it
    is the last point of the path that is only a step away.
    """
    best, metres = -1, 0.0
    for k in range(1, len(path)):
        at, last = path[k], path[k - 1]
        metres += math.hypot(points[at, 0] - points[last, 0], points[at, 1] - points[last, 1])
        away = math.hypot(points[at, 0] - x, points[at, 1] - y)
        if _is_clear(x, y, points[at, 0], points[at, 1], clear, column0, row0) or (best < 0 and away < _NEXT_M):
            best = at
        elif best >= 0:
            return best
        if metres >= _AHEAD_M:
            return at if best < 0 else best
    return path[-1] if best < 0 else best


@numba.njit(cache=True, nogil=True)
def _is_clear(x, y, to_x, to_y, clear, column0, row0):  # type: ignore[no-untyped-def]
    metres = math.hypot(to_x - x, to_y - y)
    steps = int(metres / _STEP_M) + 1
    for step in range(1, steps + 1):
        if step * metres < 0.15 * steps and metres > 0.3:
            continue  # where it is, it may be too near a wall
        column = math.floor((x + (to_x - x) * step / steps) / CELL) - column0
        row = math.floor((y + (to_y - y) * step / steps) / CELL) - row0
        if not (0 <= row < clear.shape[0] and 0 <= column < clear.shape[1] and clear[row, column]):
            return False
    return True
