"""A level in the mirror: all that stands, walks or can be pushed moves as one, and comes back."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from imagine.sim.level import Crate, Level, Person, load_level, mirrored, rectangle

FLAGS = list(itertools.product((False, True), repeat=3))
coordinates = st.floats(0.5, 9.5)
points = st.tuples(coordinates, coordinates)
crates = st.builds(
    Crate, center=points, size=st.tuples(st.floats(0.2, 1.0), st.floats(0.2, 1.0)), yaw_deg=st.floats(-180, 180)
)
people = st.builds(Person, loop=st.lists(points, min_size=2, max_size=5))


@st.composite
def levels(draw: st.DrawFn) -> Level:
    """A level of an odd outline that holds some of everything; it need not be one that can be explored."""
    width, depth, x, y = (
        draw(st.floats(10, 20)),
        draw(st.floats(10, 20)),
        draw(st.floats(-5, 5)),
        draw(st.floats(-5, 5)),
    )
    outline = np.array(
        [[x, y], [x + width, y], [x + width, y + depth * 0.6], [x + width / 3, y + depth], [x, y + depth]]
    )
    solids = [np.array(draw(st.lists(points, min_size=3, max_size=6))) for _ in range(draw(st.integers(0, 2)))]
    boxes = [rectangle(draw(points), (0.5, 1.0), draw(st.floats(0, 3))) for _ in range(draw(st.integers(0, 2)))]
    circles = np.array([[*draw(points), 0.3] for _ in range(draw(st.integers(0, 2)))], float).reshape(-1, 3)
    return Level(
        "drawn", "", outline, tuple(boxes), circles, draw(points), tuple(solids),
        tuple(draw(st.lists(people, max_size=2))), tuple(draw(st.lists(crates, max_size=2))),
    )  # fmt: skip


def marks(level: Level) -> NDArray[np.float64]:
    """All points that make up a level, a crate's corners left out, since their order changes."""
    return np.vstack(
        [
            np.array([level.launch]), level.outline, *level.polygons, *level.solids, level.circles[:, :2],
            *(np.array(person.loop) for person in level.people), *(np.array([crate.center]) for crate in level.crates),
        ]
    )  # fmt: skip


def undo(flags: tuple[bool, bool, bool]) -> tuple[bool, bool, bool]:
    swap, flip_x, flip_y = flags
    return (True, flip_y, flip_x) if swap else flags


@given(levels(), st.sampled_from(FLAGS))
def test_distances_stay(level: Level, flags: tuple[bool, bool, bool]) -> None:
    seen = mirrored(level, *flags)
    before, after = marks(level), marks(seen)
    np.testing.assert_allclose(
        np.linalg.norm(after[:, None] - after[None], axis=2),
        np.linalg.norm(before[:, None] - before[None], axis=2),
        atol=1e-9,
    )
    assert seen.circles[:, 2].tolist() == level.circles[:, 2].tolist()


@given(levels(), st.sampled_from(FLAGS))
def test_a_crate_keeps_its_place_among_the_walls(level: Level, flags: tuple[bool, bool, bool]) -> None:
    seen = mirrored(level, *flags)
    for before, after in zip(level.crates, seen.crates, strict=True):
        for reference, image in zip(level.outline, seen.outline, strict=True):
            np.testing.assert_allclose(
                np.sort(np.hypot(*(before.corners() - reference).T)), np.sort(np.hypot(*(after.corners() - image).T)),
                atol=1e-9,
            )  # fmt: skip
        assert (after.size, after.mass_kg) == (before.size, before.mass_kg)


@given(levels(), st.sampled_from(FLAGS))
def test_a_mirror_of_a_mirror_is_the_level(level: Level, flags: tuple[bool, bool, bool]) -> None:
    back = mirrored(mirrored(level, *flags), *undo(flags))
    np.testing.assert_allclose(marks(back), marks(level), atol=1e-9)
    np.testing.assert_allclose(back.segments, level.segments, atol=1e-9)
    for again, crate in zip(back.crates, level.crates, strict=True):
        turned = (again.yaw_deg - crate.yaw_deg) % 180.0  # half a turn makes no other box
        assert min(turned, 180.0 - turned) < 1e-6
    assert [person.speed_mps for person in back.people] == [person.speed_mps for person in level.people]


@given(levels())
def test_the_outline_stays_where_it_is(level: Level) -> None:
    for flags in FLAGS:
        seen = mirrored(level, *flags)
        order = [1, 0] if flags[0] else [0, 1]
        np.testing.assert_allclose(seen.outline.min(axis=0), level.outline.min(axis=0)[order], atol=1e-9)
        np.testing.assert_allclose(seen.outline.max(axis=0), level.outline.max(axis=0)[order], atol=1e-9)


@pytest.mark.parametrize("name", ["4", "6", "house:5"])
def test_the_eight_views_of_a_level_are_eight_levels_of_the_same_floor(name: str) -> None:
    level = load_level(name)
    views = [mirrored(level, *flags) for flags in FLAGS]
    assert len({view.fingerprint() for view in views}) == 8
    for view in views:
        assert view.coverable.sum() == pytest.approx(level.coverable.sum(), rel=0.01)
        assert view.flyable.sum() == pytest.approx(level.flyable.sum(), rel=0.03)
    assert views[0].fingerprint() == level.fingerprint()
