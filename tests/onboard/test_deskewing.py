"""Deskewed scans are those that the end of the turn would have given, and maps are drawn from them where that is on."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from room_scans import ROOM, cast

from imagine.core.frames import IDENTITY, Pose, compose
from imagine.core.lidar import LD19, URG04LX, LidarSpec, Scan
from imagine.onboard.build import build_runner
from imagine.onboard.deskewing import deskewed_scan
from imagine.onboard.odometry_settings import OdometrySettings
from imagine.onboard.records import Telemetry, TickInput
from imagine.onboard.settings import DroneSettings, LaunchPose

START = Pose(4.6, 3.5, 0.4)


def turn(start: Pose, motion: Pose, spec: LidarSpec, clockwise: bool = False) -> NDArray[np.float32]:
    """Return the ranges of a turn that begins at `start` and ends after `motion`, beams taken one after another."""
    ranges = np.empty(spec.beams, np.float32)
    beams = list(range(spec.beams))
    if clockwise:
        beams = [0, *beams[:0:-1]] if spec is LD19 else beams[::-1]
    for number, beam in enumerate(beams):
        share = 1.0 - (1.0 - number / spec.beams) * spec.fov / (2.0 * math.pi)
        part = Pose(motion.x * share, motion.y * share, motion.yaw * share)
        ranges[beam] = cast(compose(start, part), spec)[beam]
    return ranges


def off_m(ranges: NDArray[np.float32], true: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far ranges are from what was to be seen there or a beam beside it, where all of these are returns."""
    beside = np.stack([np.roll(true, k) for k in (-1, 0, 1)])
    known = np.isfinite(ranges) & np.isfinite(beside).all(axis=0)
    low, high = beside.min(axis=0)[known], beside.max(axis=0)[known]
    off: NDArray[np.float64] = np.maximum(0.0, np.maximum(low - ranges[known], ranges[known] - high))
    return off


@pytest.mark.parametrize("spec", [LD19, URG04LX], ids=["ld19", "urg04lx"])
@pytest.mark.parametrize(
    "motion", [Pose(0.08, 0.0, 0.0), Pose(0.05, -0.05, 0.3), Pose(0.0, 0.0, -0.3)], ids=["along", "both", "turning"]
)
@pytest.mark.parametrize("clockwise", [False, True], ids=["ccw", "cw"])
def test_a_scan_is_what_the_end_of_its_turn_would_have_given(spec: LidarSpec, motion: Pose, clockwise: bool) -> None:
    skewed = turn(START, motion, spec, clockwise)
    true = cast(compose(START, motion), spec)
    found = deskewed_scan(Scan(1.0, skewed), spec, motion, clockwise)
    assert found.stamp == 1.0
    valid = ~np.isnan(found.ranges)
    assert valid.mean() > 0.9 - abs(motion.yaw) / spec.fov  # what turned out of sight is not seen
    assert np.percentile(off_m(found.ranges, true), 98) < 0.02  # the rest: edges, which one place sees past
    assert np.percentile(off_m(skewed, true), 98) > 0.03
    assert (np.isfinite(found.ranges) & np.isfinite(true)).sum() > 0.8 * np.isfinite(true).sum()


def test_a_drone_at_rest_sees_what_it_saw() -> None:
    ranges = cast(START, LD19).astype(np.float32)
    ranges[10], ranges[20] = np.nan, np.inf
    np.testing.assert_allclose(deskewed_scan(Scan(0.0, ranges), LD19, IDENTITY).ranges, ranges, rtol=1e-6)


def test_beams_without_return_turn_with_the_drone_and_the_nearer_of_two_returns_is_kept() -> None:
    ranges = np.full(LD19.beams, np.nan, np.float32)
    ranges[0] = np.inf  # straight ahead, a whole turn before the stamp
    found = deskewed_scan(Scan(0.0, ranges), LD19, Pose(0.0, 0.0, math.radians(10.0))).ranges
    assert np.flatnonzero(np.isinf(found)).tolist() == [350]
    assert np.isnan(np.delete(found, 350)).all()
    ranges[0], ranges[350] = 1.0, 3.0  # ten degrees back, the first: where the other one, hardly moved, is too
    found = deskewed_scan(Scan(0.0, ranges), LD19, Pose(0.0, 0.0, math.radians(10.0))).ranges
    assert found[350] == pytest.approx(1.0)
    assert np.isfinite(found).sum() == 1


def wall_cells_off(deskew: bool) -> float:
    """Fly to the left and look about, with skewed scans; return the share of occupied cells that lie off any wall."""
    settings = DroneSettings(
        policy=None, odometry=OdometrySettings(deskew=deskew), launch=LaunchPose(x=1.5, y=1.5, yaw=0.0)
    )
    runner = build_runner(settings, None, None)
    pose = settings.launch.pose
    for tick in range(40):
        motion = IDENTITY if tick == 0 else Pose(0.0, 0.05, 0.1 * math.sin(0.3 * tick))
        ranges, pose = turn(pose, motion, LD19), compose(pose, motion)
        stamp = 0.1 * (tick + 1)
        output = runner.tick(TickInput(stamp, Scan(stamp, ranges), Telemetry(stamp, yaw=pose.yaw)))
        assert output.status.tracked
    belief, (column0, row0) = runner.evidence.belief(), runner.evidence.origin_cells
    rows, columns = np.nonzero(belief > 0)
    x, y = 0.1 * (columns + column0 + 0.5), 0.1 * (rows + row0 + 0.5)
    x0, y0, x1, y1 = (ROOM[:, k][:, None] for k in range(4))
    share = np.clip(((x - x0) * (x1 - x0) + (y - y0) * (y1 - y0)) / ((x1 - x0) ** 2 + (y1 - y0) ** 2), 0.0, 1.0)
    off = np.hypot(x - x0 - share * (x1 - x0), y - y0 - share * (y1 - y0)).min(axis=0)
    return float((off > 0.15).mean())


def test_maps_of_a_turning_drone_are_drawn_from_the_deskewed_scan() -> None:
    assert wall_cells_off(deskew=True) < 0.01
    assert wall_cells_off(deskew=False) > 0.03
