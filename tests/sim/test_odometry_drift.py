"""The drift model: what it draws, that a fit finds what was put in, and that odometry in flight is off by as much."""

from __future__ import annotations

import math

import numpy as np
import pytest
from drift_flights import fly, rms_at
from numpy.typing import NDArray

from imagine.sim.odometry_drift import (
    SKEWED,
    DriftSettings,
    OdometryDrift,
    Track,
    fit,
    pose_errors,
    replayed,
    rms_error,
)
from imagine.sim.workers import Workers

ON = DriftSettings(enabled=True)


def ways(count: int, ticks: int, seed: int = 0, turning: float = 0.5) -> NDArray[np.float64]:
    """Return smooth random ways `[ticks, count, 1, 3]` at 0.8 m/s and up to `turning` rad/s."""
    rng = np.random.default_rng(seed)
    course = np.cumsum(rng.normal(0.0, 0.2, (ticks, count)), axis=0)
    steps = 0.08 * np.stack((np.cos(course), np.sin(course)), axis=-1)
    yaw = np.cumsum(0.1 * turning * rng.uniform(-1.0, 1.0, (ticks, count)), axis=0)
    return np.concatenate((np.cumsum(steps, axis=0), yaw[..., None]), axis=-1)[:, :, None]


def estimates(
    settings: DriftSettings, poses: NDArray[np.float64], seed: int = 0, threads: int = 1
) -> NDArray[np.float64]:
    drift = OdometryDrift(poses.shape[1], poses.shape[2], settings, 0.1, Workers(threads))
    for world in range(poses.shape[1]):
        drift.reset(world, np.random.default_rng([seed, world]))
    return np.stack([drift.advance(now) for now in poses])


def tracks_of(poses: NDArray[np.float64], estimated: NDArray[np.float64]) -> list[Track]:
    return [(poses[:, k, 0], estimated[:, k, 0]) for k in range(poses.shape[1])]


def test_by_default_drones_know_where_they_are() -> None:
    poses = ways(3, 20)
    np.testing.assert_array_equal(estimates(DriftSettings(), poses), poses)


def test_the_launch_pose_is_known_and_drift_grows_like_a_random_walk_until_it_levels_off() -> None:
    settings = DriftSettings(enabled=True, sigma_m=0.1, length_m=10.0, jitter_m=0.0, lag_s=0.0, spread=0.0)
    poses = ways(2000, 801)
    errors = estimates(settings, poses)[:, :, 0, :2] - poses[:, :, 0, :2]
    assert (errors[0] == 0.0).all()
    for tick in (1, 20, 100, 800):
        share = 1.0 - math.exp(-2.0 * 0.08 * tick / 10.0)
        assert errors[tick].std() == pytest.approx(0.1 * math.sqrt(share), rel=0.06)
        assert errors[tick].mean() == pytest.approx(0.0, abs=0.01)


def test_who_hovers_does_not_drift_and_who_turns_does_where_asked_to() -> None:
    still = np.tile([1.0, 2.0, 0.5], (50, 4, 1, 1))
    quiet = ON.model_copy(update={"jitter_m": 0.0, "jitter_rad": 0.0})
    np.testing.assert_allclose(estimates(quiet, still), still)
    turning = still.copy()
    turning[..., 2] += 0.2 * np.arange(50)[:, None, None]
    np.testing.assert_allclose(estimates(quiet.model_copy(update={"per_rad_m": 0.0}), turning)[..., :2], still[..., :2])
    drifted = estimates(quiet.model_copy(update={"per_rad_m": 0.5}), turning)
    assert np.hypot(*(drifted - turning)[-1, :, 0, :2].T).max() > 0.003


def test_yaw_stays_within_half_a_turn_and_passes_over_its_seam() -> None:
    poses = ways(5, 400)
    poses[..., 2] = np.remainder(0.3 * np.arange(400)[:, None, None] + np.pi, 2 * np.pi) - np.pi
    estimated = estimates(ON, poses)
    assert (np.abs(estimated[..., 2]) <= math.pi).all()
    for track in tracks_of(poses, estimated):
        assert np.abs(pose_errors(*track)[:, 2]).max() < 0.1


def test_an_episodes_drift_depends_on_its_generator_alone() -> None:
    poses = ways(6, 60)
    together = estimates(ON, poses)
    np.testing.assert_array_equal(together, estimates(ON, poses, threads=3))
    alone = OdometryDrift(1, 1, ON, 0.1)
    for _ in range(2):  # a second episode that is drawn alike is alike
        alone.reset(0, np.random.default_rng([0, 4]))
        again = np.stack([alone.advance(now) for now in poses[:, [4]]])
        np.testing.assert_array_equal(again[:, 0], together[:, 4])
    assert not np.array_equal(estimates(ON, poses, seed=1), together)
    errors = (together - poses)[:, :, 0, 0]
    assert (np.abs(np.corrcoef(errors[1:].T) - np.eye(6)) < 0.95).all()


def test_drones_differ_from_flight_to_flight_as_the_spread_says() -> None:
    poses = ways(500, 150)
    even = np.log(rms_error(tracks_of(poses, estimates(ON.model_copy(update={"spread": 0.0}), poses))))
    spread = np.log(rms_error(tracks_of(poses, estimates(ON.model_copy(update={"spread": 0.8}), poses))))
    assert spread.std() > even.std() + 0.15


def test_a_fit_finds_the_constants_that_tracks_were_drawn_with() -> None:
    truth = DriftSettings(
        enabled=True, sigma_m=0.06, length_m=8.0, sigma_rad=0.01, length_rad_m=3.0, per_rad_m=0.0,
        jitter_m=0.004, jitter_rad=0.002, lag_s=0.03, spread=0.5,
    )  # fmt: skip
    poses = ways(200, 800, seed=3)
    found = fit(tracks_of(poses, estimates(truth, poses)), 0.1)
    for name in ("sigma_m", "length_m", "sigma_rad", "length_rad_m", "jitter_m", "jitter_rad", "lag_s", "spread"):
        assert getattr(found, name) == pytest.approx(getattr(truth, name), rel=0.3), name
    turning = truth.model_copy(update={"per_rad_m": 0.4})
    poses = np.concatenate((ways(100, 800, seed=4, turning=5.0), ways(100, 800, seed=5, turning=0.0)), axis=1)
    assert fit(tracks_of(poses, estimates(turning, poses)), 0.1).per_rad_m == pytest.approx(0.4, rel=0.4)


@pytest.mark.parametrize(("skew", "settings"), [(False, ON), (True, SKEWED)])
def test_the_model_is_off_by_what_the_odometry_in_flight_is_off_by(skew: bool, settings: DriftSettings) -> None:
    """Flights that the constants were not fitted to: all levels, half of them turning, at equal distances flown."""
    tracks: list[Track] = []
    for name in "123456":
        flown, _ = fly(name, 7 + int(name), 250, turning=int(name) % 2 == 0, skew=skew, deskew=skew, drones=2)
        tracks += flown
    drawn = [track for seed in range(20) for track in replayed(settings, tracks, 0.1, seed)]
    for first, last in ((0, 60), (60, 250)):  # about 4 m, and from there to about 18 m
        measured, modelled = rms_at(tracks, first, last), rms_at(drawn, first, last)
        assert 0.5 < modelled[0] / measured[0] < 2.0
        assert 0.5 < modelled[1] / measured[1] < 2.0


def test_a_turning_drone_keeps_track_of_skewed_scans_only_if_it_undoes_the_skew() -> None:
    lost, refused = fly("4", 1, 250, turning=True, skew=True, deskew=False, drones=2)
    kept, _ = fly("4", 1, 250, turning=True, skew=True, deskew=True, drones=2)
    assert rms_error(kept).max() < 0.15
    assert refused > 20
    assert rms_error(lost).max() > 5.0 * rms_error(kept).max()
