"""The Kalman filter against motions whose truth is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from imagine.core.frames import Pose, wrap_angle
from imagine.onboard.estimator import Estimator, EstimatorSettings

DT = 0.1


def circle(i: int, radius: float = 2.0, rate: float = 0.4) -> tuple[Pose, tuple[float, float]]:
    """Return pose and velocity, nose along the path, after `i` steps round a circle."""
    a = rate * DT * i
    pose = Pose(radius * math.sin(a), radius * (1.0 - math.cos(a)), wrap_angle(a))
    return pose, (radius * rate * math.cos(a), radius * rate * math.sin(a))


def test_starts_at_the_launch_pose_at_rest() -> None:
    estimate = Estimator(Pose(3.0, -2.0, 1.0)).estimate
    assert estimate.pose == Pose(3.0, -2.0, 1.0)
    assert estimate.velocity == (0.0, 0.0)
    assert (estimate.variance > 0).all()
    assert estimate.variance.shape == (5,)


def test_follows_a_circle_and_is_smoother_than_its_odometry() -> None:
    rng = np.random.default_rng(0)
    estimator = Estimator()
    off, raw, velocity_off = [], [], []
    for i in range(300):
        pose, velocity = circle(i)
        turn = wrap_angle(pose.yaw - circle(i - 1)[0].yaw) if i else None
        noise = rng.normal(0.0, (0.02, 0.02, 0.01))
        estimator.predict(i * DT, turn)
        assert estimator.update_odometry(Pose(*(np.array(pose) + noise))) is None
        if i > 50:
            e = estimator.estimate
            off.append(math.hypot(e.pose.x - pose.x, e.pose.y - pose.y))
            raw.append(math.hypot(*noise[:2]))
            velocity_off.append(math.hypot(e.velocity[0] - velocity[0], e.velocity[1] - velocity[1]))
            assert abs(wrap_angle(e.pose.yaw - pose.yaw)) < 0.03
            assert e.yaw_rate == pytest.approx(0.4)
    assert np.sqrt(np.mean(np.square(off))) < np.sqrt(np.mean(np.square(raw)))
    assert np.sqrt(np.mean(np.square(velocity_off))) < 0.2  # half of what differencing the odometry gives


def test_errors_match_the_variance_it_states() -> None:
    rng = np.random.default_rng(1)
    ratios = []
    for _ in range(40):
        estimator = Estimator()
        x = vx = 0.0
        for i in range(40):
            estimator.predict(i * DT, 0.0 if i else None)
            if i:
                push = rng.normal(0.0, estimator.settings.acceleration_mps2)
                x, vx = x + vx * DT + push * DT * DT / 2.0, vx + push * DT
            estimator.update_odometry(Pose(x + rng.normal(0.0, 0.02), rng.normal(0.0, 0.02), rng.normal(0.0, 0.01)))
        e = estimator.estimate
        ratios += [(e.pose.x - x) ** 2 / e.variance[0], (e.velocity[0] - vx) ** 2 / e.variance[3]]
    assert 0.6 < np.mean(ratios) < 1.6  # normalised errors squared: 1 on average for a consistent filter


def test_without_odometry_it_coasts_and_its_variance_grows() -> None:
    estimator = Estimator()
    for i in range(20):
        estimator.predict(i * DT, 0.0 if i else None)
        estimator.update_odometry(Pose(0.8 * DT * i, 0.0, 0.0))
    before = estimator.estimate
    for i in range(20, 25):
        estimator.predict(i * DT, 0.1)
    after = estimator.estimate
    assert after.pose.x == pytest.approx(before.pose.x + before.velocity[0] * 5 * DT)
    assert after.pose.yaw == pytest.approx(before.pose.yaw + 0.5, abs=0.02)
    assert (after.variance > before.variance).all()


def test_learns_the_drift_of_the_yaw_prior() -> None:
    rng = np.random.default_rng(2)
    estimator = Estimator(settings=EstimatorSettings(yaw_rate_rad_s=0.01, yaw_drift_rad_s2=0.005))
    for i in range(600):
        estimator.predict(i * DT, 0.02 * DT if i else None)  # the prior turns, the drone does not
        estimator.update_odometry(Pose(0.0, 0.0, rng.normal(0.0, 0.01)))
    held = estimator.estimate.pose.yaw
    for i in range(600, 650):
        estimator.predict(i * DT, 0.02 * DT)
    assert estimator.estimate.pose.yaw - held == pytest.approx(0.0, abs=0.03)  # 0.1 rad without the learnt drift


def test_a_jump_is_refused_with_a_reason_and_counted_until_odometry_fits_again() -> None:
    estimator = Estimator()
    for i in range(10):
        estimator.predict(i * DT, 0.0 if i else None)
        estimator.update_odometry(Pose(0.0, 0.0, 0.0))
    estimator.predict(10 * DT, 0.0)
    reason = estimator.update_odometry(Pose(2.0, 0.0, 0.0))
    assert reason is not None
    assert "2.00 m" in reason
    assert estimator.refused_in_a_row == 1
    assert abs(estimator.estimate.pose.x) < 0.01
    assert estimator.update_odometry(Pose(math.nan, 0.0, 0.0)) is not None
    assert estimator.refused_in_a_row == 2
    assert estimator.update_odometry(Pose(0.0, 0.0, 0.0)) is None
    assert estimator.refused_in_a_row == 0


def test_yaw_stays_wrapped_and_innovations_take_the_short_way_round() -> None:
    estimator = Estimator(Pose(0.0, 0.0, math.pi - 0.01))
    for i in range(10):
        estimator.predict(i * DT, 0.005 if i else None)
        assert estimator.update_odometry(Pose(0.0, 0.0, wrap_angle(math.pi - 0.01 + 0.005 * i))) is None
    assert estimator.estimate.pose.yaw == pytest.approx(-math.pi + 0.035, abs=0.01)


@pytest.mark.parametrize("variance", [-1.0, -1e-4])
def test_a_covariance_that_is_none_is_a_refusal_in_words(variance: float) -> None:
    estimator = Estimator()
    estimator.predict(0.0)
    reason = estimator.update_odometry(Pose(0.05, 0.0, 0.0), np.diag([variance, variance, variance]))
    assert reason is not None
    assert "cannot be told" in reason
    assert estimator.refused_in_a_row == 1


def test_a_stamp_that_does_not_advance_changes_nothing() -> None:
    estimator = Estimator()
    estimator.predict(1.0)
    before = estimator.estimate
    estimator.predict(1.0, 0.5)
    estimator.predict(0.5, 0.5)
    after = estimator.estimate
    assert after.pose == before.pose
    assert after.stamp == 1.0


def test_a_wide_covariance_moves_the_estimate_less() -> None:
    moved = []
    for scale in (1.0, 100.0):
        estimator = Estimator()
        estimator.predict(0.0)
        estimator.predict(DT, 0.0)
        estimator.update_odometry(Pose(0.05, 0.0, 0.0), np.diag([4e-4, 4e-4, 1e-4]) * scale)
        moved.append(estimator.estimate.pose.x)
    assert 0.0 < moved[1] < moved[0] < 0.05
