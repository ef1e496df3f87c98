"""A turn of the LiDAR taken while the drone moves: beams come one after another, each from where the drone then was.

A scan is stamped at the end of its turn. Beam i of n was taken (1 − i / n) of a period earlier, at the pose that the
drone's velocity and yaw rate lead back to, both taken as constant over the turn. All else stands as it is at the
stamp. A sensor that looks round only part of a turn takes its beams in that part of the period, the last at the stamp.

Every obstacle is drawn exactly. Its ends, seen from the whole of the way, bound the beams that can meet it; within
those each beam is tested from its own place.
"""

from __future__ import annotations

import math

import numba

from imagine.sim.level_index import square_of
from imagine.sim.rays import angle_of

_TWO_PI = 2.0 * math.pi
_SLACK_RAD = 1e-6
_SEAM = 1e-12
_TOUCH_M = 1e-7


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_rays(rays, heading, velocity, increment, turn_s):  # type: ignore[no-untyped-def]
    """Fill `rays` (float64 `[4, beams]`) with each beam's place relative to the last pose and its direction.

    Map axes, metres; `heading` is beam 0's if the drone stood still. Returns what `draw_moving` bounds beams by: the
    first beam's angle, the angle from beam to beam, and the way from the last pose back to the first.
    """
    beams = rays.shape[1]
    for beam in range(beams):
        ago = (1.0 - beam / beams) * turn_s
        angle = heading - velocity[2] * ago + beam * increment
        rays[0, beam], rays[1, beam] = -velocity[0] * ago, -velocity[1] * ago
        rays[2, beam], rays[3, beam] = math.cos(angle), math.sin(angle)
    turned = velocity[2] * turn_s
    return heading - turned, increment + turned / beams, -velocity[0] * turn_s, -velocity[1] * turn_s


@numba.njit(cache=True, nogil=True, error_model="numpy")
def draw_moving(  # type: ignore[no-untyped-def]
    inverse, rays, fan, levels, row, poses, drone, alive, discs, edges, drone_radius, limit
):
    """Raise `inverse` (float64 `[beams]`, 1/m) to the inverse range of the nearest thing each of the `rays` meets.

    `fan` is what `fill_rays` returned; the rest as for `scan_world`, of one world.
    """
    x, y = poses[drone, 0], poses[drone, 1]
    way_x, way_y = fan[2], fan[3]
    travel = math.hypot(way_x, way_y)
    now, before = square_of(levels, row, x, y), square_of(levels, row, x + way_x, y + way_y)
    first_circle = levels.shape[row, 2]
    for visit in range(1 if now == before else 2):  # what faces neither end of the way faces no place between
        square = before if visit else now
        for at in range(levels.starts[row, square], levels.starts[row, square + 1]):
            if levels.nearest[row, at] > limit + travel:
                break
            item = levels.items[row, at]
            if item < first_circle:
                edge = levels.edges[row, item]
                _draw_edge(inverse, rays, edge[0] - x, edge[1] - y, edge[2] - x, edge[3] - y, fan)
            else:
                circle = levels.circles[row, item - first_circle]
                _draw_disc(inverse, rays, circle[0] - x, circle[1] - y, circle[2], fan)
    for k in range(len(discs) + len(poses)):
        other = k - len(discs)
        if other < 0:
            _draw_disc(inverse, rays, discs[k, 0] - x, discs[k, 1] - y, discs[k, 2], fan)
        elif other != drone and alive[other]:
            _draw_disc(inverse, rays, poses[other, 0] - x, poses[other, 1] - y, drone_radius, fan)
    for k in range(2 * len(edges)):  # of loops that turn either way, so they are seen from both sides
        a, b = (0, 2) if k % 2 == 0 else (2, 0)
        edge = edges[k // 2]
        _draw_edge(inverse, rays, edge[a] - x, edge[a + 1] - y, edge[b] - x, edge[b + 1] - y, fan)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _draw_edge(inverse, rays, ax, ay, bx, by, fan):  # type: ignore[no-untyped-def]
    """Draw an edge that is seen with b counter-clockwise of a; its ends are metres from where the way ends."""
    way_x, way_y = fan[2], fan[3]
    ex, ey = bx - ax, by - ay
    touch = _TOUCH_M * math.hypot(ex, ey)
    if touch == 0.0 or max(ax * ey - ay * ex, (ax - way_x) * ey - (ay - way_y) * ex) < -touch:
        return
    low, high = _arc(ax, ay, bx, by, ax - way_x, ay - way_y, bx - way_x, by - way_y)
    for turn in range(-1, 2):  # an arc may begin before beam 0, and a turning drone sees its first beams' part again
        first, last = _beams(len(inverse), low, high, turn, fan)
        for beam in range(first, last):
            px, py, ux, uy = ax - rays[0, beam], ay - rays[1, beam], rays[2, beam], rays[3, beam]
            qx, qy = px + ex, py + ey
            cross, facing = px * ey - py * ex, ux * ey - uy * ex
            if facing <= 0.0:
                continue
            if cross > touch:
                inside = px * uy - py * ux >= -_SEAM * (abs(px) + abs(py))
                if inside and ux * qy - uy * qx >= -_SEAM * (abs(qx) + abs(qy)):
                    inverse[beam] = max(inverse[beam], facing / cross)
            elif cross >= -touch and px * ex + py * ey <= 0.0 <= qx * ex + qy * ey:
                inverse[beam] = 1.0 / _TOUCH_M


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _draw_disc(inverse, rays, cx, cy, radius, fan):  # type: ignore[no-untyped-def]
    """Draw a disc, centre in metres from where the way ends; around the sensor, or without radius, it is unseen."""
    if radius <= 0.0:
        return
    way_x, way_y = fan[2], fan[3]
    low, high = 0.0, _TWO_PI
    now = math.sqrt(max(cx * cx + cy * cy - radius * radius, 0.0))
    then_x, then_y = cx - way_x, cy - way_y
    then = math.sqrt(max(then_x * then_x + then_y * then_y - radius * radius, 0.0))
    if now > 0.0 and then > 0.0:
        first_low, first_high = _arc(
            cx * now + cy * radius, cy * now - cx * radius, cx * now - cy * radius, cy * now + cx * radius,
            then_x * then + then_y * radius, then_y * then - then_x * radius,
            then_x * then - then_y * radius, then_y * then + then_x * radius,
        )  # fmt: skip
        low, high = first_low, first_high
    for turn in range(-1, 2):
        first, last = _beams(len(inverse), low, high, turn, fan)
        for beam in range(first, last):
            px, py = cx - rays[0, beam], cy - rays[1, beam]
            power = px * px + py * py - radius * radius
            along = px * rays[2, beam] + py * rays[3, beam]
            if power > 0.0 and along > 0.0 and along * along >= power:
                inverse[beam] = max(inverse[beam], (along + math.sqrt(along * along - power)) / power)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _arc(ax, ay, bx, by, cx, cy, dx, dy):  # type: ignore[no-untyped-def]
    """Return begin and end of the arc that holds four directions, all of a turn where no half-plane does."""
    first = angle_of(ax, ay)
    low = high = 0.0
    for vx, vy in ((bx, by), (cx, cy), (dx, dy)):
        off = (angle_of(vx, vy) - first + 3.0 * math.pi) % _TWO_PI - math.pi
        low, high = min(low, off), max(high, off)
    if not high - low < math.pi - _SLACK_RAD:
        return 0.0, _TWO_PI
    return first + low, first + high


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _beams(beams, low, high, turn, fan):  # type: ignore[no-untyped-def]
    """Return first beam and the one past the last that look into an arc, counted from `turn` turns before it."""
    offset = (low - fan[0]) % _TWO_PI + turn * _TWO_PI
    return (
        max(0, math.ceil((offset - _SLACK_RAD) / fan[1])),
        min(beams, math.floor((offset + (high - low) + _SLACK_RAD) / fan[1]) + 1),
    )
