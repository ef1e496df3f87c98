"""A layer placed in another frame: each own cell takes one of its cells, and only what changed is drawn anew."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imagine.core.errors import InputError
from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.frames import IDENTITY, Pose, inverse, transform_points
from imagine.core.placed_layer import PlacedLayer
from imagine.core.raster import CELL, LIMIT, TILE

ANYWHERE = st.builds(Pose, st.floats(-6, 6), st.floats(-6, 6), st.floats(-math.pi, math.pi))
FEW = settings(max_examples=25, deadline=None)


def tile(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(-LIMIT, LIMIT + 1, (TILE, TILE)).astype(np.int8)


def plainly(evidence: EvidenceMap, source: int, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    """The placed layer cell by cell, as its definition says, and the cells whose centres fall on edges."""
    rows, columns = evidence.shape
    column0, row0 = evidence.origin_cells
    row, column = np.mgrid[:rows, :columns]
    own = np.column_stack(((column.ravel() + column0 + 0.5) * CELL, (row.ravel() + row0 + 0.5) * CELL))
    exact = transform_points(inverse(pose), own) / CELL
    at = np.floor(exact).astype(int) - (column0, row0)
    inside = ((at >= 0) & (at < (columns, rows))).all(axis=1)
    out = np.zeros(rows * columns, np.int8)
    out[inside] = evidence.layers[source].cells[at[inside, 1], at[inside, 0]]
    is_on_edge = (np.abs(exact - np.rint(exact)) < 1e-6).any(axis=1)  # rounding may send it either way
    return out.reshape(rows, columns), is_on_edge.reshape(rows, columns)


@FEW
@given(pose=ANYWHERE, seed=st.integers(0, 1000))
def test_tiles_drawn_one_by_one_are_the_layer_drawn_at_once(pose: Pose, seed: int) -> None:
    evidence = EvidenceMap(1)
    evidence.place(2, pose)
    for k, key in enumerate([TileKey(0, 0), TileKey(-1, 1), TileKey(0, 0), TileKey(2, -2)]):
        evidence.merge_tile(2, key, k + 1, tile(seed + k))
        belief = evidence.belief()
        expected, is_on_edge = plainly(evidence, 2, pose)
        np.testing.assert_array_equal(belief[~is_on_edge], expected[~is_on_edge])
    assert np.count_nonzero(belief) > 2000


def test_a_layer_without_place_is_held_but_not_believed_and_moves_with_its_place() -> None:
    evidence = EvidenceMap(1, shares_frame=False)
    evidence.merge_tile(2, TileKey(0, 0), 1, np.full((TILE, TILE), 5, np.int8))
    assert not evidence.belief().any()
    assert evidence.versions(2) == {TileKey(0, 0): 1}
    evidence.place(2, Pose(3.2, 0.0, 0.0))
    belief = evidence.belief()
    rows, columns = np.nonzero(belief)
    assert (belief[rows, columns] == 5).all()
    assert len(rows) == pytest.approx(TILE * TILE, abs=2 * TILE)
    assert (columns + evidence.origin_cells[0]).min() in (31, 32)
    evidence.place(2, Pose(0.0, 0.0, math.pi / 2))
    rows, columns = np.nonzero(evidence.belief())
    assert (columns + evidence.origin_cells[0]).max() < 0 <= (rows + evidence.origin_cells[1]).min() + 1
    evidence.place(2, None)
    assert not evidence.belief().any()
    assert (evidence.layers[2].cells == 5).sum() == TILE * TILE


def test_the_identity_is_the_layer_itself() -> None:
    evidence = EvidenceMap(1)
    evidence.merge_tile(2, TileKey(0, 0), 1, tile(1))
    before = evidence.belief()
    evidence.place(2, IDENTITY)
    assert evidence.placed()[2] is evidence.layers[2].cells
    np.testing.assert_array_equal(evidence.belief(), before)


def test_the_grid_grows_to_hold_a_placed_layer_and_what_is_too_far_away_is_left_out() -> None:
    evidence = EvidenceMap(1, half_extent_m=3.2)
    evidence.merge_tile(2, TileKey(0, 0), 1, np.full((TILE, TILE), 3, np.int8))
    evidence.place(2, Pose(20.0, 0.0, 0.0))
    assert np.count_nonzero(evidence.belief()) == pytest.approx(TILE * TILE, abs=2 * TILE)
    evidence.place(2, Pose(1e6, 0.0, 0.0))
    assert not evidence.belief().any()
    assert max(evidence.shape) * CELL <= 128.0


def test_a_place_that_is_none_is_refused() -> None:
    evidence = EvidenceMap(1)
    with pytest.raises(InputError, match="not finite"):
        evidence.place(2, Pose(math.nan, 0.0, 0.0))
    with pytest.raises(InputError, match="drone itself"):
        evidence.place(1, Pose(1.0, 0.0, 0.0))


def test_nothing_is_drawn_where_nothing_changed() -> None:
    cells = np.zeros((2 * TILE, 2 * TILE), np.int8)
    cells[3, 4] = 7
    placed = PlacedLayer(Pose(0.5, 0.2, 0.1))
    placed.refresh(cells, (0, 0))
    placed.cells[:] = 1  # had it been drawn, this would be gone
    placed.refresh(cells, (0, 0))
    assert (placed.cells == 1).all()
    cells[TILE + 20, TILE + 20] = 3
    placed.refresh(cells, (0, 0))
    assert not (placed.cells == 1).all()
