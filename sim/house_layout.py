"""The bare house: an outline, the rooms it is divided into, and doors that connect all of them."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

from imagine.sim.dice import Dice

Point = tuple[float, float]

WALL_M = 0.1
_DOOR_M = (0.8, 1.1)
_LEAST_SIDE_M = 2.0
_JAMB_M = 0.1  # of wall at least between a door and the corner
_CORRIDOR_M = (1.2, 1.7)
_CORRIDOR_AREA_M2 = 70.0  # larger floors are divided by a corridor
_EVEN = 4  # draws of a room's size: the mean of so many


@dataclass(frozen=True)
class Rect:
    """An axis-aligned rectangle, metres."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def width(self) -> float:
        """Return the extent in x."""
        return self.x1 - self.x0

    @property
    def depth(self) -> float:
        """Return the extent in y."""
        return self.y1 - self.y0

    @property
    def area(self) -> float:
        """Return the area, square metres."""
        return self.width * self.depth

    def overlaps(self, other: Rect) -> bool:
        """Tell whether two rectangles have more than an edge in common."""
        hair = 1e-6
        return (
            self.x0 < other.x1 - hair
            and other.x0 < self.x1 - hair
            and self.y0 < other.y1 - hair
            and other.y0 < self.y1 - hair
        )


@dataclass(frozen=True)
class Room:
    """A room, up to the middle of its walls."""

    rect: Rect
    corridor: bool = False


@dataclass(frozen=True)
class Door:
    """An opening in the wall between two rooms (indices), from `low` to `high` along it, its frame not counted."""

    rooms: tuple[int, int]
    upright: bool
    """The wall runs along y, at x = `at`; otherwise along x, at y = `at`."""
    at: float
    low: float
    high: float


@dataclass(frozen=True)
class Layout:
    """A house without furniture: outline, rooms, doors, and walls as lines [start, end], metres."""

    outline: list[Point]
    rooms: list[Room]
    doors: list[Door]
    walls: list[list[Point]]


@dataclass(frozen=True)
class _Shared:
    """The stretch of wall that two rooms have in common."""

    rooms: tuple[int, int]
    upright: bool
    at: float
    low: float
    high: float


def draw_layout(dice: Dice, area_m2: float) -> Layout | None:
    """Draw a house of about this floor area; None where the draw gave rooms that no door can connect."""
    columns = _draw_columns(dice, area_m2)
    rooms: list[Room] = []
    floors = columns
    spine = _draw_spine(dice, columns, area_m2)
    if spine is not None:
        rooms.append(Room(spine, corridor=True))
        floors = [half for c in columns for half in _beside(c, spine)]
    for floor in floors:
        _divide(dice, floor, rooms)
    shared = _shared_walls(rooms)
    doors = _draw_doors(dice, rooms, shared)
    if doors is None:
        return None
    return Layout(_outline(columns), rooms, doors, _walls(shared, doors))


def _draw_columns(dice: Dice, area_m2: float) -> list[Rect]:
    """Draw the outline as one to three rectangles side by side: a block, an L, a T, a U or a Z."""
    count = 1 if dice.chance(0.4) else 2 if area_m2 < 90.0 or dice.chance(0.55) else 3
    aspect = dice.between(1.0, 1.9) if count == 1 else dice.between(1.1, 2.0)
    shares = [dice.between(0.7, 1.3) for _ in range(count)]
    full = dice.pick(range(count))
    spans = []
    for k in range(count):
        cut = 0.0 if k == full else dice.between(0.2, 0.42)
        spans.append((cut, 1.0) if dice.chance(0.5) else (0.0, 1.0 - cut))
    filled = sum(share * (high - low) for share, (low, high) in zip(shares, spans, strict=True)) / sum(shares)
    depth = math.sqrt(area_m2 / (aspect * filled))
    width = aspect * depth
    edges = [0.0, *itertools.accumulate(share / sum(shares) * width for share in shares)]
    return [
        Rect(round(x0, 1), round(low * depth, 1), round(x1, 1), round(high * depth, 1))
        for (x0, x1), (low, high) in zip(itertools.pairwise(edges), spans, strict=True)
    ]


def _draw_spine(dice: Dice, columns: list[Rect], area_m2: float) -> Rect | None:
    """Draw a corridor through the whole house, or None where it is small or does without."""
    wanted = area_m2 >= _CORRIDOR_AREA_M2 and dice.chance(0.75)
    width, share = dice.between(*_CORRIDOR_M), dice.unit()
    low, high = max(c.y0 for c in columns), min(c.y1 for c in columns)
    least = 2.6  # of depth beside the corridor
    if not wanted or high - low < width + 2 * least:
        return None
    y = round(low + least + share * (high - low - width - 2 * least), 2)
    return Rect(columns[0].x0, y, columns[-1].x1, round(y + width, 2))


def _beside(column: Rect, spine: Rect) -> list[Rect]:
    return [Rect(column.x0, column.y0, column.x1, spine.y0), Rect(column.x0, spine.y1, column.x1, column.y1)]


def _divide(dice: Dice, floor: Rect, rooms: list[Room]) -> None:
    """Divide a floor into rooms: by a corridor while it is large and deep, else by walls, down to rooms' size."""
    along_x = floor.width >= floor.depth
    longer, shorter = max(floor.width, floor.depth), min(floor.width, floor.depth)
    wanted_area = 7.0 + 20.0 * sum(dice.unit() for _ in range(_EVEN)) / _EVEN
    share = 0.36 + 0.28 * dice.unit()
    hall = floor.area < 48.0 and shorter > 4.0 and dice.chance(0.12)
    corridor = dice.between(*_CORRIDOR_M)
    if floor.area > 85.0 and shorter > 7.5 and dice.chance(0.85):
        cut = round((floor.y0 if along_x else floor.x0) + share * (shorter - corridor), 2)
        for half in _split(floor, not along_x, cut, cut + corridor):
            _divide(dice, half, rooms)
        strip = (
            Rect(floor.x0, cut, floor.x1, round(cut + corridor, 2))
            if along_x
            else Rect(cut, floor.y0, round(cut + corridor, 2), floor.y1)
        )
        rooms.append(Room(strip, corridor=True))
    elif hall or floor.area <= wanted_area * 1.35 or longer * min(share, 1.0 - share) < _LEAST_SIDE_M:
        rooms.append(Room(floor))
    else:
        cut = round((floor.x0 if along_x else floor.y0) + share * longer, 2)
        for half in _split(floor, along_x, cut, cut):
            _divide(dice, half, rooms)


def _split(rect: Rect, along_x: bool, low: float, high: float) -> tuple[Rect, Rect]:
    high = round(high, 2)
    if along_x:
        return Rect(rect.x0, rect.y0, low, rect.y1), Rect(high, rect.y0, rect.x1, rect.y1)
    return Rect(rect.x0, rect.y0, rect.x1, low), Rect(rect.x0, high, rect.x1, rect.y1)


def _shared_walls(rooms: list[Room]) -> list[_Shared]:
    shared = []
    for (i, a), (j, b) in itertools.combinations(enumerate(room.rect for room in rooms), 2):
        if a.x1 == b.x0 or b.x1 == a.x0:
            low, high, at, upright = max(a.y0, b.y0), min(a.y1, b.y1), a.x1 if a.x1 == b.x0 else a.x0, True
        elif a.y1 == b.y0 or b.y1 == a.y0:
            low, high, at, upright = max(a.x0, b.x0), min(a.x1, b.x1), a.y1 if a.y1 == b.y0 else a.y0, False
        else:
            continue
        if high > low:
            shared.append(_Shared((i, j), upright, at, low, high))
    return shared


def _draw_doors(dice: Dice, rooms: list[Room], shared: list[_Shared]) -> list[Door] | None:
    """Draw doors: enough to get everywhere, through corridors where there are some, and a few more."""
    weighed = []
    for wall in shared:
        corridors = sum(rooms[k].corridor for k in wall.rooms)
        weighed.append((dice.unit() + (1.0, 0.2, -1.0)[corridors], wall, corridors))
    weighed.sort(key=lambda item: (item[0], item[1].rooms))
    group = list(range(len(rooms)))
    doors, groups = [], len(rooms)
    for _, wall, corridors in weighed:
        first, second = (group[k] for k in wall.rooms)
        extra = dice.chance((0.14, 0.10, 1.0)[corridors])
        if first == second and not extra:
            continue
        door = _draw_door(dice, rooms, wall, corridors)
        if door is None:
            continue
        doors.append(door)
        if first != second:
            group = [first if g == second else g for g in group]
            groups -= 1
    return doors if groups == 1 else None


def _draw_door(dice: Dice, rooms: list[Room], wall: _Shared, corridors: int) -> Door | None:
    """Draw an opening in a wall: a door, often beside a corner, or a wide passage; None if the wall is too short."""
    clear = dice.between(*_DOOR_M)
    room = wall.high - wall.low - 2 * _JAMB_M - WALL_M  # a wall ends half its thickness past its line's end
    wide = corridors == 0 and min(rooms[k].rect.area for k in wall.rooms) > 10.0 and dice.chance(0.25)
    if wide and room > 1.6:
        clear = dice.between(1.4, min(room, 2.8))
    if corridors == 2:
        clear = max(clear, round(room, 2))
    at_corner, share, far = dice.chance(0.6), dice.unit(), dice.chance(0.5)
    if room < clear:
        clear = _DOOR_M[0]
        if room < clear:
            return None
    slack = room - clear
    offset = min(0.15, slack) if at_corner else share * slack
    low = round(wall.low + _JAMB_M + WALL_M / 2 + (slack - offset if far else offset), 2)
    return Door(wall.rooms, wall.upright, wall.at, low, round(low + clear, 2))


def _walls(shared: list[_Shared], doors: list[Door]) -> list[list[Point]]:
    """Return the walls between rooms less the doors, stretches in line joined."""
    openings = {door.rooms: door for door in doors}
    lines: dict[tuple[bool, float], list[tuple[float, float]]] = {}
    for wall in shared:
        line = lines.setdefault((wall.upright, wall.at), [])
        door = openings.get(wall.rooms)
        if door is None:
            line.append((wall.low, wall.high))
        else:
            line.append((wall.low, round(door.low - WALL_M / 2, 3)))
            line.append((round(door.high + WALL_M / 2, 3), wall.high))
    walls: list[list[Point]] = []
    for (upright, at), stretches in sorted(lines.items()):
        joined: list[tuple[float, float]] = []
        for low, high in sorted(stretches):
            if joined and low <= joined[-1][1]:
                joined[-1] = (joined[-1][0], max(high, joined[-1][1]))
            else:
                joined.append((low, high))
        walls += [[(at, low), (at, high)] if upright else [(low, at), (high, at)] for low, high in joined]
    return walls


def _outline(columns: list[Rect]) -> list[Point]:
    """Return the outline of rectangles side by side, counter-clockwise, without corners on straight lines."""
    below = [point for c in columns for point in ((c.x0, c.y0), (c.x1, c.y0))]
    above = [point for c in reversed(columns) for point in ((c.x1, c.y1), (c.x0, c.y1))]
    points: list[Point] = []
    for point in (*below, *above):
        if not points or point != points[-1]:
            points.append(point)
    kept = []
    for k, (x, y) in enumerate(points):
        (ax, ay), (bx, by) = points[k - 1], points[(k + 1) % len(points)]
        if not (ax == x == bx or ay == y == by):
            kept.append((x, y))
    return kept
