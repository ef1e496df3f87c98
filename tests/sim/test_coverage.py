"""Coverage is the share of the cells that can be reached which some drone has seen, by the truth."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from imagine.core.lidar import LidarSpec
from imagine.sim.coverage import Coverage
from imagine.sim.level import Level, load_level
from imagine.sim.rays import cast_rays

LIDAR = LidarSpec(beams=720, noise_std=0.0)
TWO_ROOMS = load_level("4")


def look(level: Level, x: float, y: float) -> NDArray[np.float32]:
    ranges = np.empty(LIDAR.beams)
    cast_rays(ranges, level.segments, level.circles, x, y, 0.0, LIDAR.increment, LIDAR.range_max)
    return ranges.astype(np.float32)


def test_an_empty_room_is_seen_at_a_glance_from_its_middle() -> None:
    level = load_level("0")
    share = Coverage(level, 1, LIDAR, 6.0).update(np.array([[3.0, 3.0, 0.0]]), look(level, 3.0, 3.0)[None])
    assert share == pytest.approx(1.0, abs=0.01)


def test_the_cap_limits_what_is_seen_to_its_disc() -> None:
    level = load_level("0")
    share = Coverage(level, 1, LIDAR, 2.0).update(np.array([[3.0, 3.0, 0.0]]), look(level, 3.0, 3.0)[None])
    assert share == pytest.approx(np.pi * 1.95**2 / 36.0, rel=0.05)  # the cell at a beam's end is not freed


def test_a_team_adds_up_and_nothing_counts_twice() -> None:
    poses = np.array([[1.4, 1.4, 0.0], [14.0, 10.0, 0.0]])
    scans = np.stack([look(TWO_ROOMS, x, y) for x, y, _ in poses])
    shares = [Coverage(TWO_ROOMS, 1, LIDAR, 4.0).update(poses[[k]], scans[[k]]) for k in (0, 1)]
    team = Coverage(TWO_ROOMS, 2, LIDAR, 4.0)
    together = team.update(poses, scans)
    assert together == pytest.approx(sum(shares))
    assert team.update(poses, scans) == together
    same = Coverage(TWO_ROOMS, 2, LIDAR, 4.0).update(poses[[0, 0]], scans[[0, 0]])
    assert same == shares[0]


def test_it_never_falls_and_invalid_scans_add_nothing() -> None:
    coverage = Coverage(TWO_ROOMS, 1, LIDAR, 4.0)
    nothing = np.full((1, LIDAR.beams), np.nan, np.float32)
    assert coverage.update(np.array([[1.4, 1.4, 0.0]]), nothing) == 0.0
    rng = np.random.default_rng(0)
    last = 0.0
    for _ in range(30):
        x, y = rng.uniform(0.5, 15.5), rng.uniform(0.5, 11.5)
        if TWO_ROOMS.is_free(np.array([[x, y]]), 0.1)[0]:
            share = coverage.update(np.array([[x, y, 0.0]]), look(TWO_ROOMS, x, y)[None])
            assert last <= share <= 1.0
            last = share
    assert last > 0.5
