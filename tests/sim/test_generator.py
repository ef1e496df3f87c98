"""Generated houses: the same for the same seed, all different, connected, and seen everywhere."""

from __future__ import annotations

import hashlib
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from imagine.core.errors import InputError
from imagine.core.lidar import LidarSpec
from imagine.core.raster import CELL
from imagine.sim.coverage import Coverage
from imagine.sim.dice import Dice
from imagine.sim.generator import AREA_M2, ROOM_TO_FLY_M, generate_file, generate_level
from imagine.sim.house_layout import Rect, draw_layout
from imagine.sim.level import Level, load_level
from imagine.sim.level_check import hidden_regions, room_for
from imagine.sim.level_file import level_text
from imagine.sim.level_survey import reachable
from imagine.sim.polygon import signed_area
from imagine.sim.rays import cast_rays

HOUSES = 1000


def test_a_thousand_houses_are_connected_seen_everywhere_and_all_different() -> None:
    prints, areas, corners = set(), [], set()
    for seed in range(HOUSES):
        level = generate_level(seed)
        prints.add(level.fingerprint())
        assert not hidden_regions(level), seed
        assert level.coverable.sum() > 0.985 * level.free.sum(), seed
        _, clearance = level.geometry.lattice()
        reached = reachable(clearance, level.grid, level.launch)
        assert not ((clearance >= ROOM_TO_FLY_M) & ~reached).any(), seed  # wherever there is room, a way leads
        assert len(level.launch_spots) > 1000, seed
        areas.append(signed_area(level.outline))
        corners.add(len(level.outline))
    assert len(prints) == HOUSES
    assert min(areas) < 60.0
    assert max(areas) > 350.0
    assert {4, 6, 8} <= corners  # blocks, Ls, and Ts, Us and Zs


@pytest.mark.parametrize("seed", [3, 11, 34, 90])
def test_drones_that_fly_everywhere_see_all_that_counts(seed: int) -> None:
    level = generate_level(seed, 60.0)
    lidar = LidarSpec(beams=720, noise_std=0.0)
    coverage, seen = Coverage(level, 1, lidar, 4.0), 0.0
    ranges = np.empty(lidar.beams)
    rows, columns = np.nonzero(level.flyable)
    for x, y in np.column_stack(((columns + level.grid[0] + 0.5) * CELL, (rows + level.grid[1] + 0.5) * CELL))[::3]:
        cast_rays(ranges, level.segments, level.circles, x, y, 0.0, lidar.increment, lidar.range_max)
        seen = coverage.update(np.array([[x, y, 0.0]]), ranges.astype(np.float32)[None])
    assert seen > 0.9995


def test_a_seed_gives_the_same_house_everywhere_and_always() -> None:
    # Rounded to what a file holds: the last bit of a sine may differ from one machine to the next.
    texts = "".join(level_text(generate_file(seed)) for seed in range(20))
    assert hashlib.sha256(texts.encode()).hexdigest()[:16] == "03fbf97cd75d669b"
    assert generate_level(7).fingerprint() == load_level("house:7").fingerprint()
    assert generate_level(7, 120.0).fingerprint() == load_level("house:7:120").fingerprint()


@given(st.integers(0, 2**63 - 1), st.none() | st.floats(*AREA_M2), st.integers(0, 3), st.integers(0, 4))
@settings(max_examples=20)
def test_its_yaml_reads_back_to_the_same_geometry(seed: int, area: float | None, people: int, crates: int) -> None:
    from imagine.core.config import parse_yaml
    from imagine.sim.level_file import read_level

    level = generate_level(seed, area, people, crates)
    text = level_text(generate_file(seed, area, people, crates))
    again = read_level("again", "again", *parse_yaml(text, "again"))
    assert again.fingerprint() == level.fingerprint()
    assert (again.coverable == level.coverable).all()
    assert (again.title, again.name) == (level.title, "again")


@given(st.integers(0, 2**32), st.floats(*AREA_M2))
@settings(max_examples=40)
def test_the_area_is_the_one_asked_for(seed: int, area: float) -> None:
    assert signed_area(generate_level(seed, area).outline) == pytest.approx(area, rel=0.04)


@given(st.integers(0, 2**32))
@example(10252)  # a corridor as narrow as any
@settings(max_examples=60)
def test_rooms_fill_the_outline_and_doors_lie_in_their_walls(seed: int) -> None:
    dice = Dice(np.random.Generator(np.random.PCG64(seed)))
    layout = None
    while layout is None:
        layout = draw_layout(dice, 180.0)
    rects = [room.rect for room in layout.rooms]
    assert sum(rect.area for rect in rects) == pytest.approx(signed_area(np.array(layout.outline)), rel=1e-6)
    assert not any(a.overlaps(b) for a, b in itertools.combinations(rects, 2))
    assert min(min(rect.width, rect.depth) for rect in rects) >= 1.2 - 1e-9  # coordinates are rounded
    for door in layout.doors:
        assert door.high - door.low >= 0.8 - 1e-9
        for k in door.rooms:
            rect = rects[k]
            low, high = (rect.y0, rect.y1) if door.upright else (rect.x0, rect.x1)
            assert door.at in ((rect.x0, rect.x1) if door.upright else (rect.y0, rect.y1))
            assert low < door.low < door.high < high


def test_furniture_stands_inside_and_leaves_the_doors_free() -> None:
    for seed in range(12):
        file = generate_file(seed)
        assert file.outline is not None
        outline = np.array(file.outline)
        boxes = np.concatenate([box.corners() for box in file.boxes])
        assert len(file.boxes) >= 4
        assert (boxes >= outline.min(axis=0) - 1e-6).all()
        assert (boxes <= outline.max(axis=0) + 1e-6).all()
        assert file.people == []
        assert file.crates == []


def test_people_walk_free_of_walls_and_crates_stand_free() -> None:
    level = generate_level(5, people=3, crates=4)
    assert (len(level.people), len(level.crates)) == (3, 4)
    for person in level.people:
        for (x0, y0), (x1, y1) in itertools.pairwise([*person.loop, person.loop[0]]):
            t = np.linspace(0.0, 1.0, 50)[:, None]
            assert level.is_free(np.array([[x0, y0]]) * (1 - t) + np.array([[x1, y1]]) * t, 0.2).all()
    assert all(level.is_free(crate.corners()).all() for crate in level.crates)
    assert all(math.dist(crate.center, level.launch) > 1.0 for crate in level.crates)
    assert room_for(level, 3) == 3


@pytest.mark.parametrize(("seed", "area"), [(1, 49.0), (1, 401.0), (1, float("nan"))])
def test_areas_out_of_range_are_refused(seed: int, area: float) -> None:
    with pytest.raises(InputError, match="50 to 400 m²"):
        generate_level(seed, area)


def test_rects_that_share_an_edge_do_not_overlap() -> None:
    assert not Rect(0, 0, 2, 2).overlaps(Rect(2, 0, 4, 2))
    assert Rect(0, 0, 2, 2).overlaps(Rect(1.9, 1.9, 4, 4))


def test_a_house_is_a_level_wherever_one_is_asked_for(tmp_path: Path) -> None:
    from imagine.sim.exploration import Exploration
    from imagine.sim.exploration_settings import ExplorationSettings

    env = Exploration(ExplorationSettings(levels=("house:3", "0"), worlds=2, drones=2), seed=0)
    env.reset()
    step = env.step(np.zeros((2, 2, env.settings.action.size), np.float32))
    assert step.reward.shape == (2, 2)
    assert isinstance(env.twin.levels[0], Level)
