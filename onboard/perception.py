"""From a LiDAR scan to where the drone is: odometry, then estimator. Flight and replay run this very step."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from imagine.core.config import Settings
from imagine.core.frames import IDENTITY, Pose, wrap_angle
from imagine.core.lidar import LidarSpec, Scan
from imagine.onboard.deskewing import deskewed_scan
from imagine.onboard.estimator import Estimator, EstimatorSettings
from imagine.onboard.odometry import LidarOdometry, OdometryResult
from imagine.onboard.odometry_settings import OdometrySettings


class PerceptionSettings(Settings):
    """Settings of the two stages, and when their failing means being lost."""

    odometry: OdometrySettings = Field(default_factory=OdometrySettings)
    estimator: EstimatorSettings = Field(default_factory=EstimatorSettings)
    lost_after: int = Field(default=5, ge=1, description="so many scans in a row without a fix mean the drone is lost")


class PerceptionResult(NamedTuple):
    """Where the drone is at `stamp`, map frame: pose, velocity (m/s), yaw rate (rad/s), variances of x, y, yaw, vx, vy.

    `ok` is false, and `reason` says why, when the scan added nothing: the pose is then a prediction and must not be
    used to draw the scan into the map. `lost` is true when that has lasted too long to go on flying by it. `scan` is
    what maps are drawn from: the scan as the end of its turn would have seen it, or as it came where nothing deskews.
    """

    stamp: float
    pose: Pose
    velocity: tuple[float, float]
    yaw_rate: float
    variance: NDArray[np.float64]
    ok: bool
    lost: bool
    reason: str | None
    odometry: OdometryResult
    scan: Scan


class Perception:
    """Odometry and estimator of one drone, fed once per scan."""

    def __init__(self, spec: LidarSpec, settings: PerceptionSettings | None = None, launch: Pose = IDENTITY) -> None:
        """Start at `launch` in the map frame."""
        self.settings = settings or PerceptionSettings()
        self.odometry = LidarOdometry(spec, self.settings.odometry, launch)
        self.estimator = Estimator(launch, self.settings.estimator)
        self._spec = spec
        self._stamp: float | None = None
        self._yaw_prior: float | None = None
        self._failed_in_a_row = 0

    def update(self, scan: Scan, yaw_prior: float | None = None) -> PerceptionResult:
        """Take one scan; `yaw_prior` is the autopilot's yaw at its stamp, radians counter-clockwise, any origin."""
        increment = None
        if yaw_prior is not None and self._yaw_prior is not None:
            increment = wrap_angle(yaw_prior - self._yaw_prior)
        self._yaw_prior = yaw_prior
        self.estimator.predict(scan.stamp, increment)
        odometry = self.odometry.update(scan, yaw_prior)
        reason = odometry.reason
        if odometry.ok:
            reason = self.estimator.update_odometry(odometry.pose)
        self._failed_in_a_row = 0 if reason is None else self._failed_in_a_row + 1
        mapped = self._deskewed(scan, odometry.delta) if self.settings.odometry.deskew else scan
        self._stamp = scan.stamp
        estimate = self.estimator.estimate
        return PerceptionResult(
            stamp=scan.stamp,
            pose=estimate.pose,
            velocity=estimate.velocity,
            yaw_rate=estimate.yaw_rate,
            variance=estimate.variance,
            ok=reason is None,
            lost=self._failed_in_a_row >= self.settings.lost_after,
            reason=reason,
            odometry=odometry,
            scan=mapped,
        )

    def _deskewed(self, scan: Scan, delta: Pose) -> Scan:
        """Put a scan right by what the drone did since the last one, which may be several turns ago."""
        if self._stamp is None:
            return scan
        share = min(1.0, 1.0 / (self._spec.rate_hz * (scan.stamp - self._stamp)))
        motion = Pose(delta.x * share, delta.y * share, delta.yaw * share)
        return deskewed_scan(scan, self._spec, motion, self.settings.odometry.clockwise)
