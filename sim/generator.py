"""Furnished houses by seed: levels without end for training that should carry over to any house."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from imagine.core.errors import InputError
from imagine.sim.dice import Dice
from imagine.sim.furniture import KEPT_OPEN_M, Furnished, Piece, furnish
from imagine.sim.house_layout import WALL_M, Layout, draw_layout
from imagine.sim.level import Box, Crate, Level, Person, Point
from imagine.sim.level_check import check_level, hidden_regions
from imagine.sim.level_file import Circle, LevelFile, build_level
from imagine.sim.level_survey import lattice_point, reachable

PREFIX = "house:"
AREA_M2 = (50.0, 400.0)
"""The least and the greatest floor area."""
ROOM_TO_FLY_M = KEPT_OPEN_M + 0.06
"""Wherever there is so much clearance in a house, a way leads; rooms are furnished on a lattice of 0.1 m."""
_DRAWS = 100

Group = tuple[Piece, ...]


def is_generated(name: str) -> bool:
    """Tell whether a level's name, or a range of them, is of generated houses."""
    return name.startswith(PREFIX)


def level_by_seed(name: str) -> Level:
    """Return the generated level of a name such as house:7 or house:7:120. Raises InputError for any other name."""
    seed_text, colon, area_text = name.removeprefix(PREFIX).partition(":")
    if not (seed_text.isascii() and seed_text.isdecimal()) or int(seed_text) >= 2**63:
        raise InputError(f"level {name}: expected house:SEED or house:SEED:AREA, such as house:7 or house:7:120")
    area = None
    if colon:
        try:
            area = float(area_text)
        except ValueError as error:
            raise InputError(f"level {name}: '{area_text}' is no area in square metres, such as 120") from error
    return generate_level(int(seed_text), area, name=name)


def generate_level(
    seed: int, area_m2: float | None = None, people: int = 0, crates: int = 0, name: str | None = None
) -> Level:
    """Return the furnished house of a seed, checked: connected, and all of it seen from where drones can fly."""
    return _generate(seed, area_m2, people, crates, name)[0]


def generate_file(seed: int, area_m2: float | None = None, people: int = 0, crates: int = 0) -> LevelFile:
    """Return the same house as what its YAML holds."""
    return _generate(seed, area_m2, people, crates, None)[1]


def _generate(seed: int, area_m2: float | None, people: int, crates: int, name: str | None) -> tuple[Level, LevelFile]:
    if area_m2 is not None and not AREA_M2[0] <= area_m2 <= AREA_M2[1]:
        raise InputError(f"level {name or f'house:{seed}'}: a house has {AREA_M2[0]:g} to {AREA_M2[1]:g} m²")
    dice = Dice(np.random.Generator(np.random.PCG64(seed)))
    drawn = AREA_M2[0] * (AREA_M2[1] / AREA_M2[0]) ** dice.unit()  # small houses are more common than large ones
    area = round(drawn if area_m2 is None else area_m2, 1)
    name = name or (f"{PREFIX}{seed}" if area_m2 is None else f"{PREFIX}{seed}:{area_m2:g}")
    for _ in range(_DRAWS):
        layout = draw_layout(dice, area)
        if layout is None:
            continue
        rooms = furnish(dice, layout)
        launch = _draw_launch(dice, layout, rooms)
        if launch is None:
            continue
        file = LevelFile(
            title=f"house {seed}, {area:g} m²", outline=layout.outline, launch=launch, wall_thickness_m=WALL_M,
            walls=layout.walls,
        )  # fmt: skip
        level, file = _without_hiding_places(name, file, [group for room in rooms for group in room.groups])
        if people or crates:
            file = file.model_copy(update=_draw_movers(dice, rooms, people, crates, level))
            level = _build(name, file)
        return check_level(level, lambda *_: f"level {name}"), file
    raise InputError(f"level {name}: no house of {area:g} m² came of this seed: take another")


def _draw_launch(dice: Dice, layout: Layout, rooms: list[Furnished]) -> tuple[float, float] | None:
    """Draw where the team starts: at one end of the first corridor, or of the largest room."""
    by_area = sorted(range(len(rooms)), key=lambda k: (not layout.rooms[k].corridor, -layout.rooms[k].rect.area, k))
    direction = dice.pick(((1.0, 0.1), (-1.0, 0.1), (0.1, 1.0), (0.1, -1.0)))
    for k in by_area:
        clear = rooms[k].clear
        if len(clear):
            x, y = clear[np.argmax(np.round(clear @ np.array(direction), 6))]
            return float(x), float(y)
    return None


def _build(name: str, file: LevelFile) -> Level:
    return build_level(name, file, lambda *_: f"level {name}")


def _without_hiding_places(name: str, bare: LevelFile, groups: list[Group]) -> tuple[Level, LevelFile]:
    """Return the house with its furniture, less what hides a region from drones or cuts them off from one."""
    groups = list(groups)
    while True:
        pieces = [piece for group in groups for piece in group]
        boxes = [Box(center=p.center, size=p.size, yaw_deg=p.yaw_deg) for p in pieces if not p.radius]
        posts = [Circle(center=p.center, radius=p.radius) for p in pieces if p.radius]
        file = bare.model_copy(update={"boxes": boxes, "circles": posts})
        level = _build(name, file)
        wrong = [region.point for region in hidden_regions(level)] + _cut_off(level)
        if not wrong or not groups:
            return level, file
        for point in wrong:
            if groups:
                groups.remove(min(groups, key=lambda group: min(_apart(piece, point) for piece in group)))


def _cut_off(level: Level) -> list[Point]:
    """Return a point in each place with room to fly that no way leads to."""
    _, clearance = level.geometry.lattice()
    reached = reachable(clearance, level.grid, level.launch)
    labels, count = ndimage.label((clearance >= ROOM_TO_FLY_M) & ~reached)
    firsts = [np.argwhere(labels == number)[0] for number in range(1, count + 1)]
    return [lattice_point((int(row), int(column)), level.grid) for row, column in firsts]


def _apart(piece: Piece, point: Point) -> float:
    rect, (x, y) = piece.rect, point
    return math.hypot(max(rect.x0 - x, x - rect.x1, 0.0), max(rect.y0 - y, y - rect.y1, 0.0))


def _draw_movers(
    dice: Dice, rooms: list[Furnished], people: int, crates: int, level: Level
) -> dict[str, list[Person] | list[Crate]]:
    """Draw people who walk about in a room each, and crates that stand where nothing else does."""
    roomy = [[(float(x), float(y)) for x, y in room.clear] for room in rooms if len(room.clear) > 20]
    walkers: list[Person] = []
    boxes: list[Crate] = []
    for _ in range(_DRAWS * people):
        if len(walkers) == people:
            break
        clear = dice.pick(roomy)
        loop = [dice.pick(clear) for _ in range(dice.pick((2, 3, 4)))]
        speed = dice.between(0.4, 1.2)
        if min(math.dist(a, b) for a, b in zip(loop, [*loop[1:], loop[0]], strict=True)) > 1.0 and all(
            _is_clear(level, a, b, 0.25) for a, b in zip(loop, [*loop[1:], loop[0]], strict=True)
        ):
            walkers.append(Person(loop=loop, speed_mps=speed))
    for _ in range(_DRAWS * crates):
        if len(boxes) == crates:
            break
        size = (dice.between(0.3, 0.5), dice.between(0.3, 0.5))
        crate = Crate(
            center=dice.pick(dice.pick(roomy)),
            size=size,
            yaw_deg=dice.between(-45.0, 45.0),
            mass_kg=dice.between(0.5, 4.0),
        )
        if (
            all(math.dist(crate.center, other.center) > 1.0 for other in boxes)
            and all(math.dist(crate.center, person.loop[0]) > 1.0 for person in walkers)
            and math.dist(crate.center, level.launch) > 1.5
            and level.is_free(crate.corners(), 0.02).all()
        ):
            boxes.append(crate)
    return {"people": walkers, "crates": boxes}


def _is_clear(level: Level, start: tuple[float, float], end: tuple[float, float], clearance_m: float) -> bool:
    steps = max(2, math.ceil(math.dist(start, end) / 0.1))
    t = np.linspace(0.0, 1.0, steps + 1)[:, None]
    return bool(level.is_free(np.array(start) * (1.0 - t) + np.array(end) * t, clearance_m).all())
