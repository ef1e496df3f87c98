"""Furniture: what stands in which room, and where, so that drones still get everywhere."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.sim.dice import Dice
from imagine.sim.furniture_kinds import ALONG_WALLS, Kind, Range
from imagine.sim.house_layout import Door, Layout, Rect, Room

KEPT_OPEN_M = 0.3
"""Ways through furnished rooms are at least twice as wide as this."""
_STEP_M = 0.1
_DOOR_ZONE_M = 0.85  # nothing stands so close before a door
_TRIES = 4


@dataclass(frozen=True)
class Piece:
    """Something that stands in a room: a box (`radius` 0), or a post; its `rect` holds it. Metres, degrees."""

    center: tuple[float, float]
    size: tuple[float, float]
    yaw_deg: float = 0.0
    radius: float = 0.0

    @property
    def rect(self) -> Rect:
        """Return the upright rectangle that holds the piece."""
        yaw = math.radians(self.yaw_deg)
        c, s = abs(math.cos(yaw)), abs(math.sin(yaw))
        half_x = self.radius or (self.size[0] * c + self.size[1] * s) / 2.0
        half_y = self.radius or (self.size[0] * s + self.size[1] * c) / 2.0
        x, y = self.center
        return Rect(x - half_x, y - half_y, x + half_x, y + half_y)


@dataclass
class _Space:
    """A room while it is being furnished: what stands in it, and which points a drone can still use."""

    room: Room
    kind: str
    doors: list[Door]
    groups: list[tuple[Piece, ...]] = field(default_factory=list)
    zones: list[Rect] = field(default_factory=list)
    taken: list[Rect] = field(default_factory=list)

    def __post_init__(self) -> None:
        rect = self.room.rect
        rows, columns = int(rect.depth / _STEP_M), int(rect.width / _STEP_M)
        self.blocked = np.zeros((rows, columns), np.bool_)
        edge = math.ceil((KEPT_OPEN_M + 0.05) / _STEP_M - 0.5)  # half the wall's thickness stands in the room
        self.blocked[:edge] = self.blocked[rows - edge :] = True
        self.blocked[:, :edge] = self.blocked[:, columns - edge :] = True
        seeds = []
        for door in self.doors:
            middle = (door.low + door.high) / 2.0
            reach, wide = _DOOR_ZONE_M, 0.1
            if door.upright:
                side = 1.0 if abs(door.at - rect.x0) < 1e-6 else -1.0
                x0, x1 = sorted((door.at, door.at + side * reach))
                self.zones.append(Rect(x0, door.low - wide, x1, door.high + wide))
                seeds.append((middle - rect.y0, door.at + side * (edge + 0.5) * _STEP_M - rect.x0))
            else:
                side = 1.0 if abs(door.at - rect.y0) < 1e-6 else -1.0
                y0, y1 = sorted((door.at, door.at + side * reach))
                self.zones.append(Rect(door.low - wide, y0, door.high + wide, y1))
                seeds.append((door.at + side * (edge + 0.5) * _STEP_M - rect.y0, middle - rect.x0))
        low = edge
        self.seeds = np.array(
            [
                (min(max(int(y / _STEP_M), low), rows - edge - 1), min(max(int(x / _STEP_M), low), columns - edge - 1))
                for y, x in seeds
            ],
            np.int64,
        ).reshape(-1, 2)

    def place(self, *pieces: Piece) -> bool:
        """Put pieces that belong together into the room, all or none: where they are free to stand and block no way."""
        rects = [piece.rect for piece in pieces]
        rect = self.room.rect
        hair = 1e-6
        for r in rects:
            if r.x0 < rect.x0 - hair or r.y0 < rect.y0 - hair or r.x1 > rect.x1 + hair or r.y1 > rect.y1 + hair:
                return False
            if any(r.overlaps(other) for other in (*self.zones, *self.taken)):
                return False
        blocked = self.blocked.copy()
        for r in rects:
            x0, x1 = (r.x0 - KEPT_OPEN_M - rect.x0) / _STEP_M, (r.x1 + KEPT_OPEN_M - rect.x0) / _STEP_M
            y0, y1 = (r.y0 - KEPT_OPEN_M - rect.y0) / _STEP_M, (r.y1 + KEPT_OPEN_M - rect.y0) / _STEP_M
            blocked[max(0, math.ceil(y0 - 0.5)) : math.floor(y1 - 0.5) + 1,
                    max(0, math.ceil(x0 - 0.5)) : math.floor(x1 - 0.5) + 1] = True  # fmt: skip
        if not hangs_together(blocked, self.seeds):
            return False
        self.blocked = blocked
        self.groups.append(pieces)
        self.taken += rects
        return True


@numba.njit(cache=True, nogil=True)
def hangs_together(blocked, seeds):  # type: ignore[no-untyped-def]
    """Tell whether the points of a room that are not `blocked` are one, and hold all `seeds` `[n, 2]` (row, column)."""
    rows, columns = blocked.shape
    reached = np.zeros(blocked.shape, np.bool_)
    stack = np.empty(rows * columns, np.int64)
    open_points, count, done = 0, 0, 0
    for i in range(rows):
        for j in range(columns):
            if not blocked[i, j]:
                open_points += 1
                if count == 0:
                    stack[0] = i * columns + j
                    reached[i, j] = True
                    count = 1
    while count > 0:
        count -= 1
        done += 1
        i, j = stack[count] // columns, stack[count] % columns
        for way in range(4):
            a = i + (1 if way == 0 else -1 if way == 1 else 0)
            b = j + (1 if way == 2 else -1 if way == 3 else 0)
            if 0 <= a < rows and 0 <= b < columns and not blocked[a, b] and not reached[a, b]:
                reached[a, b] = True
                stack[count] = a * columns + b
                count += 1
    found = done == open_points
    for k in range(len(seeds)):
        found = found and reached[seeds[k, 0], seeds[k, 1]]
    return found


@dataclass(frozen=True)
class Furnished:
    """A room's kind, what stands in it, and points `[n, 2]` in it that are clear of everything, metres.

    Pieces of a group belong together, as a table and its chairs do.
    """

    kind: str
    groups: list[tuple[Piece, ...]]
    clear: NDArray[np.float64]


def furnish(dice: Dice, layout: Layout) -> list[Furnished]:
    """Draw the furniture of every room of a house, in the order of its rooms."""
    clutter = dice.between(0.7, 1.25)
    kinds = _draw_kinds(dice, layout)
    furnished = []
    for index, (room, kind) in enumerate(zip(layout.rooms, kinds, strict=True)):
        space = _Space(room, kind, [door for door in layout.doors if index in door.rooms])
        _furnish_room(dice, space, clutter)
        rows, columns = np.nonzero(~space.blocked)
        clear = np.column_stack((room.rect.x0 + (columns + 0.5) * _STEP_M, room.rect.y0 + (rows + 0.5) * _STEP_M))
        furnished.append(Furnished(kind, space.groups, clear.round(3)))
    return furnished


def _draw_kinds(dice: Dice, layout: Layout) -> list[str]:
    """Draw what each room is for: the largest is lived in, the smallest are baths and stores, the rest by chance."""
    kinds = ["corridor" if room.corridor else "" for room in layout.rooms]
    by_area = sorted((k for k, kind in enumerate(kinds) if not kind), key=lambda k: (layout.rooms[k].rect.area, k))
    total = len(by_area)
    for rank, k in enumerate(by_area):
        area = layout.rooms[k].rect.area
        if rank == total - 1:
            kinds[k] = "living"
        elif rank == 0 or (area < 9.0 and rank < 2 + total // 8):
            kinds[k] = dice.pick(("bath", "bath", "bath", "store"))
        elif rank == total // 2:
            kinds[k] = "kitchen"
        elif area > 24.0:
            kinds[k] = dice.pick(("living", "dining", "study", "bedroom"))
        else:
            kinds[k] = dice.pick(("bedroom", "bedroom", "bedroom", "child", "child", "study", "dining", "store"))
    return kinds


def _furnish_room(dice: Dice, space: _Space, clutter: float) -> None:
    rounds = 1 + int(space.room.rect.area > 28.0) + int(space.room.rect.area > 45.0)
    for _ in range(rounds):
        for kind, probability in ALONG_WALLS[space.kind]:
            if dice.chance(probability * clutter):
                _against_wall(dice, space, kind)
        if space.kind in ("living", "dining", "kitchen") and dice.chance(0.8 * clutter):
            _table_with_chairs(dice, space)
        if space.kind == "living" and dice.chance(0.6 * clutter):
            _free_standing(dice, space, (0.9, 1.3), (0.5, 0.7), turned=0.3)
        if space.kind in ("living", "study", "bedroom") and dice.chance(0.5 * clutter):
            _free_standing(dice, space, (0.7, 0.9), (0.7, 0.9), turned=0.7)
    if space.kind not in ("bath", "store") and dice.chance(0.5 * clutter):
        _post(dice, space, (0.12, 0.25))
    if space.room.rect.area > 25.0 and dice.chance(0.4):
        _post(dice, space, (0.15, 0.3))


def _against_wall(dice: Dice, space: _Space, kind: Kind) -> bool:
    rect = space.room.rect
    width, depth = dice.between(*kind.width), dice.between(*kind.depth)
    for _ in range(_TRIES):
        side, share, flush, far = dice.pick(range(4)), dice.unit(), dice.chance(0.7), dice.chance(0.5)
        slack = (rect.width if side < 2 else rect.depth) - width
        if slack < 0.0:
            continue
        along = round((slack if far else 0.0) if kind.corner and flush else share * slack, 2)
        along = 0.0 if along < 0.3 else slack if along > slack - 0.3 else along  # no chinks beside a wall
        if side < 2:
            x = rect.x0 + along + width / 2.0
            y = rect.y0 + depth / 2.0 if side == 0 else rect.y1 - depth / 2.0
            piece = Piece((round(x, 3), round(y, 3)), (width, depth))
        else:
            x = rect.x0 + depth / 2.0 if side == 2 else rect.x1 - depth / 2.0
            y = rect.y0 + along + width / 2.0
            piece = Piece((round(x, 3), round(y, 3)), (depth, width))
        if space.place(piece):
            return True
    return False


def _free_standing(dice: Dice, space: _Space, width: Range, depth: Range, turned: float) -> bool:
    """Place something in the middle of a room, now and then turned a little."""
    size = (dice.between(*width), dice.between(*depth))
    for _ in range(_TRIES):
        yaw = dice.between(-25.0, 25.0) if dice.chance(turned) else 0.0
        if space.place(Piece(_somewhere(dice, space.room.rect), size, round(yaw, 1))):
            return True
    return False


def _table_with_chairs(dice: Dice, space: _Space) -> bool:
    """Place a table and the chairs pushed under it, as one."""
    long, wide = dice.between(1.1, 2.0), dice.between(0.75, 0.95)
    chair, upright, seats = dice.between(0.42, 0.5), dice.chance(0.5), dice.pick((0, 2, 4, 4))
    tucked = 0.25  # of a chair's depth under the table
    for _ in range(_TRIES):
        x, y = _somewhere(dice, space.room.rect)
        pieces = [Piece((x, y), (wide, long) if upright else (long, wide))]
        for seat in range(seats):
            across = (wide / 2.0 + chair / 2.0 - tucked) * (1 if seat % 2 else -1)
            along = 0.0 if seats == 2 else long / 4.0 * (1 if seat < 2 else -1)
            dx, dy = (across, along) if upright else (along, across)
            pieces.append(Piece((round(x + dx, 3), round(y + dy, 3)), (chair, chair)))
        if space.place(*pieces):
            return True
    return False


def _post(dice: Dice, space: _Space, radius: Range) -> bool:
    r = dice.between(*radius)
    return any(space.place(Piece(_somewhere(dice, space.room.rect), (2 * r, 2 * r), radius=r)) for _ in range(_TRIES))


def _somewhere(dice: Dice, rect: Rect) -> tuple[float, float]:
    return dice.between(rect.x0 + 0.3, rect.x1 - 0.3), dice.between(rect.y0 + 0.3, rect.y1 - 0.3)
