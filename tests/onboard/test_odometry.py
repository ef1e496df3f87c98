"""LiDAR odometry on scans of a room whose truth is known."""

from __future__ import annotations

import itertools
import math
import time

import numpy as np
import pytest
from numpy.typing import NDArray
from room_scans import ROUND, fly, measure

from imagine.core.frames import Pose, relative, wrap_angle
from imagine.core.lidar import LD19, LidarSpec, Scan
from imagine.onboard.odometry import LidarOdometry, OdometryResult


def track(truth: list[Pose], seed: int, spec: LidarSpec = LD19) -> list[OdometryResult]:
    """Run odometry over a flight; the yaw prior drifts by 0.01 rad/s from an origin of its own."""
    rng = np.random.default_rng(seed)
    odometry = LidarOdometry(spec, launch=truth[0])
    results = []
    for i, pose in enumerate(truth):
        prior = wrap_angle(pose.yaw + 1.0 + 0.001 * i + rng.normal(0.0, 0.002))
        results.append(odometry.update(measure(pose, 0.1 * i, spec, rng), prior))
    return results


def error_m(truth: list[Pose], results: list[OdometryResult]) -> NDArray[np.float64]:
    return np.array([math.hypot(r.pose.x - t.x, r.pose.y - t.y) for r, t in zip(results, truth, strict=True)])


def test_stays_within_five_centimetres_over_twenty_metres() -> None:
    truth = fly(ROUND)
    path = sum(math.hypot(b.x - a.x, b.y - a.y) for a, b in itertools.pairwise(truth))
    assert path > 20.0
    started = time.process_time()
    results = track(truth, seed=1)
    print(f"{(time.process_time() - started) / len(truth) * 1e3:.2f} ms a scan with ray casting")
    assert all(r.ok for r in results)
    assert error_m(truth, results).max() <= 0.05
    assert max(abs(wrap_angle(r.pose.yaw - t.yaw)) for r, t in zip(results, truth, strict=True)) <= math.radians(1.0)


def test_two_runs_agree_to_the_last_bit() -> None:
    truth = fly(ROUND)[:80]
    assert [r.pose for r in track(truth, seed=2)] == [r.pose for r in track(truth, seed=2)]


def test_the_first_scan_is_at_the_launch_pose() -> None:
    launch = Pose(1.5, 1.5, 2.0)
    odometry = LidarOdometry(LD19, launch=launch)
    result = odometry.update(measure(launch, 0.0, LD19, np.random.default_rng(0)), 0.3)
    assert result.ok
    assert result.pose == launch
    assert result.delta == pytest.approx((0.0, 0.0, 0.0))


def test_delta_is_the_motion_since_the_last_scan() -> None:
    truth = fly(ROUND)[:30]
    results = track(truth, seed=3)
    for before, after in itertools.pairwise(results):
        assert after.delta == pytest.approx(relative(before.pose, after.pose), abs=1e-12)


@pytest.mark.parametrize("blind", [np.inf, np.nan, 0.01], ids=["no return", "invalid", "too near"])
def test_a_scan_without_returns_is_refused_and_the_next_one_tracked(blind: float) -> None:
    truth = fly(ROUND)[:20]
    rng = np.random.default_rng(4)
    odometry = LidarOdometry(LD19, launch=truth[0])
    for i, pose in enumerate(truth):
        scan = measure(pose, 0.1 * i, LD19, rng)
        if i == 10:
            scan = Scan(scan.stamp, np.full(LD19.beams, blind, np.float32))
        result = odometry.update(scan, pose.yaw)
        assert result.ok == (i != 10)
        if i == 10:
            assert "too few returns: 0 of 360 beams" in (result.reason or "")
        assert math.hypot(result.pose.x - pose.x, result.pose.y - pose.y) < 0.1


def test_a_blind_start_waits_for_the_first_good_scan() -> None:
    odometry = LidarOdometry(LD19, launch=Pose(1.5, 1.5, 0.0))
    dark = Scan(0.0, np.full(LD19.beams, np.inf, np.float32))
    assert not odometry.update(dark, 0.0).ok
    lit = odometry.update(measure(Pose(1.5, 1.5, 0.0), 0.1, LD19, np.random.default_rng(0)), 0.0)
    assert lit.ok
    assert lit.pose == Pose(1.5, 1.5, 0.0)


def test_a_drone_carried_off_is_noticed_and_does_not_run_away() -> None:
    truth = fly(ROUND)[:20]
    elsewhere = Pose(8.5, 6.0, truth[-1].yaw)
    rng = np.random.default_rng(5)
    odometry = LidarOdometry(LD19, launch=truth[0])
    for i, pose in enumerate(truth):
        assert odometry.update(measure(pose, 0.1 * i, LD19, rng), pose.yaw).ok
    results = [odometry.update(measure(elsewhere, 2.0 + 0.1 * i, LD19, rng), elsewhere.yaw) for i in range(30)]
    assert not any(r.ok for r in results)
    assert all(r.reason for r in results)
    assert math.hypot(results[-1].pose.x - truth[-1].x, results[-1].pose.y - truth[-1].y) < 0.3


def test_yaw_prior_wraps_around() -> None:
    rng = np.random.default_rng(6)
    odometry = LidarOdometry(LD19, launch=Pose(5.0, 2.0, math.pi - 0.05))
    for i in range(20):
        pose = Pose(5.0, 2.0, wrap_angle(math.pi - 0.05 + 0.01 * i))
        result = odometry.update(measure(pose, 0.1 * i, LD19, rng), pose.yaw)
        assert result.ok
        assert abs(wrap_angle(result.pose.yaw - pose.yaw)) < math.radians(1.0)
