"""What a peer's scan writes: the same as the plain way of masking, drawing and putting newer tiles back."""

from __future__ import annotations

import numpy as np
import pytest

from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.frames import Pose
from imagine.core.lidar import LD19, Scan, mask_near
from imagine.core.peer_marks import mask_targets
from imagine.core.raster import TILE

CAP_M = 4.0


def scan_ranges(rng: np.random.Generator) -> np.ndarray:
    ranges = rng.uniform(0.05, 5.0, LD19.beams).astype(np.float32)
    ranges[rng.random(LD19.beams) < 0.1] = np.inf
    ranges[rng.random(LD19.beams) < 0.1] = np.nan
    return ranges


@pytest.mark.parametrize("seed", range(20))
def test_teammates_are_masked_as_in_own_scans(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose = Pose(*rng.uniform(-3.0, 3.0, 3).tolist())
    targets = rng.uniform(-5.0, 5.0, (4, 2))
    ranges = scan_ranges(rng)
    expected = mask_near(ranges, LD19, pose, targets, 0.5)
    masked = mask_targets(ranges, LD19.start, LD19.increment, LD19.range_max, pose, targets, 0.5)
    np.testing.assert_array_equal(masked, expected)
    assert np.isnan(masked).sum() > np.isnan(ranges).sum()


@pytest.mark.parametrize("seed", range(5))
def test_tiles_that_contain_a_scan_are_left_alone_and_the_others_drawn(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scan, pose = Scan(0.0, scan_ranges(rng)), Pose(*rng.uniform(-2.0, 2.0, 3).tolist())
    plain, ahead = EvidenceMap(1), EvidenceMap(1)
    for evidence in (plain, ahead):
        for row in (-1, 0):
            cells = np.full((TILE, TILE), 3, np.int8)
            assert evidence.merge_tile(2, TileKey(-1, row), 6 + row, cells)  # versions 5 and 6
    plain.integrate_provisional(2, pose, scan, LD19, CAP_M)
    kept = ahead.tile(2, TileKey(-1, 0)).copy()
    ahead.integrate_provisional(2, pose, scan, LD19, CAP_M, clock=6)
    assert np.array_equal(ahead.tile(2, TileKey(-1, 0)), kept)
    assert not ahead.is_provisional(2, TileKey(-1, 0))
    plain.tile(2, TileKey(-1, 0))[:] = kept
    assert np.array_equal(ahead.layers[2].cells, plain.layers[2].cells)
    assert ahead.is_provisional(2, TileKey(-1, -1))
