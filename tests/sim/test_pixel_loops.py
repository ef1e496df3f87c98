"""From pixels to polygons and back: loops enclose exactly the free pixels, and straightening moves half a pixel."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from imagine.core.raster import CELL
from imagine.sim.level_kernels import fill_loop
from imagine.sim.pixel_loops import boundary_loops, simplified, without_pinches
from imagine.sim.polygon import first_crossing, signed_area

pictures = st.tuples(st.integers(1, 14), st.integers(1, 14)).flatmap(lambda shape: arrays(np.bool_, shape))


def filled(loops: list[NDArray[np.float64]], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Rasterise loops by the kernel that lays out levels, a pixel being a cell."""
    lattice = np.zeros((2 * shape[0] + 1, 2 * shape[1] + 1), np.uint8)
    for loop in sorted(loops, key=lambda loop: -abs(signed_area(loop))):
        fill_loop(lattice, np.ascontiguousarray(loop * CELL), 0, 0, 1 if signed_area(loop) > 0 else 0)
    return lattice[1::2, 1::2].astype(bool)


def pinches(free: NDArray[np.bool_]) -> int:
    a, b, c, d = free[:-1, :-1], free[:-1, 1:], free[1:, :-1], free[1:, 1:]
    return int(((a & d & ~b & ~c) | (b & c & ~a & ~d)).sum())


@given(pictures)
def test_pixels_that_touch_by_a_corner_are_parted_and_others_kept(free: NDArray[np.bool_]) -> None:
    kept = without_pinches(free)
    assert not (kept & ~free).any()
    assert pinches(kept) == 0
    if pinches(free) == 0:
        assert (kept == free).all()


@given(pictures)
def test_loops_enclose_exactly_the_free_pixels(picture: NDArray[np.bool_]) -> None:
    free = without_pinches(picture)
    loops = boundary_loops(free)
    assert (filled(loops, free.shape) == free).all()
    assert sum(signed_area(loop) for loop in loops) == free.sum()
    for loop in loops:
        edges = np.roll(loop, -1, axis=0) - loop
        assert ((edges == 0).sum(axis=1) == 1).all()  # along the pixels' edges, and
        assert (np.abs(edges * np.roll(edges, 1, axis=0)).sum(axis=1) == 0).all()  # a corner only where it turns
        assert first_crossing(loop)[0] < 0


def distance_to(loop: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    start, edge = loop[None], (np.roll(loop, -1, axis=0) - loop)[None]
    t = np.clip(((points[:, None] - start) * edge).sum(axis=2) / (edge**2).sum(axis=2), 0.0, 1.0)
    distance: NDArray[np.float64] = np.linalg.norm(points[:, None] - start - t[..., None] * edge, axis=2).min(axis=1)
    return distance


@given(pictures)
def test_straightening_stays_within_half_a_pixel(picture: NDArray[np.bool_]) -> None:
    for loop in boundary_loops(without_pinches(picture)):
        straight = simplified(loop)
        assert first_crossing(straight)[0] < 0
        assert distance_to(loop, straight).max() <= 0.5
        assert distance_to(straight, loop).max() <= 0.5 + 1e-9


def test_stairs_become_lines_and_corners_stay() -> None:
    rows, columns = np.mgrid[:40, :40]
    (triangle,) = boundary_loops(columns >= rows)
    assert len(triangle) > 70
    assert len(simplified(triangle)) <= 6
    (square,) = boundary_loops(np.ones((7, 9), bool))
    np.testing.assert_array_equal(simplified(square), [[0, 0], [9, 0], [9, 7], [0, 7]])
    (slope,) = boundary_loops(3 * columns >= rows)
    assert len(simplified(slope)) <= 10
