"""The state estimator: an extended Kalman filter that fuses the autopilot's yaw with LiDAR odometry.

State `[x, y, yaw, vx, vy, yaw drift]`, map frame, metres, radians, m/s, rad/s: constant velocity driven by white
acceleration, yaw driven by the autopilot's increments, whose slow drift is estimated too.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from imagine.core.config import Settings
from imagine.core.frames import IDENTITY, Pose, wrap_angle
from imagine.onboard.extended_kalman import ExtendedKalmanFilter

_STATES = 6
_H = np.eye(3, _STATES)


class EstimatorSettings(Settings):
    """Noise of the filter, one standard deviation each."""

    acceleration_mps2: float = Field(default=2.0, gt=0.0, description="accelerations the motion model does not know")
    yaw_rate_rad_s: float = Field(default=0.05, gt=0.0, description="error of the autopilot's yaw increments")
    yaw_rate_blind_rad_s: float = Field(default=2.0, gt=0.0, description="turn rate to expect without a yaw prior")
    yaw_drift_rad_s2: float = Field(default=1e-4, gt=0.0, description="how fast the drift of the yaw prior wanders")
    odometry_position_m: float = Field(default=0.02, gt=0.0)
    odometry_yaw_rad: float = Field(default=0.01, gt=0.0)
    gate: float = Field(default=5.0, gt=0.0, description="odometry farther off than this many deviations is refused")


class Estimate(NamedTuple):
    """What the filter believes at `stamp`: pose and velocity in the map frame, variances of `x, y, yaw, vx, vy`."""

    stamp: float
    pose: Pose
    velocity: tuple[float, float]
    yaw_rate: float
    variance: NDArray[np.float64]


class Estimator:
    """An EKF over planar pose and velocity. Starts at the launch pose, at rest."""

    def __init__(self, launch: Pose = IDENTITY, settings: EstimatorSettings | None = None) -> None:
        """Start at `launch` in the map frame, which is known exactly enough: the map hangs on it."""
        self.settings = settings or EstimatorSettings()
        self._filter = ExtendedKalmanFilter(dim_x=_STATES, dim_z=3)
        self._filter.x = np.array([launch.x, launch.y, launch.yaw, 0.0, 0.0, 0.0])
        self._filter.P = np.diag([1e-4, 1e-4, 1e-4, 1e-2, 1e-2, 1e-6])
        self._stamp: float | None = None
        self._yaw_rate = 0.0
        self.refused_in_a_row = 0

    def predict(self, stamp: float, yaw_increment: float | None = None) -> None:
        """Carry the state to `stamp` (seconds); `yaw_increment` is the autopilot's turn since the last call, radians.

        The first call only sets the clock. A stamp that does not advance changes nothing.
        """
        if self._stamp is None or stamp <= self._stamp:
            self._stamp = stamp if self._stamp is None else self._stamp
            return
        dt = stamp - self._stamp
        self._stamp = stamp
        f, known = self._filter, yaw_increment is not None
        self._yaw_rate = yaw_increment / dt if yaw_increment is not None else self._yaw_rate
        f.F = np.eye(_STATES)
        f.F[0, 3] = f.F[1, 4] = dt
        f.F[2, 5] = dt if known else 0.0
        f.Q = self._process_noise(dt, known)
        f.B, u = np.eye(_STATES)[:, 2], yaw_increment if yaw_increment is not None else 0.0
        f.predict(u)
        f.x[2] = wrap_angle(f.x[2])

    def _process_noise(self, dt: float, yaw_known: bool) -> NDArray[np.float64]:
        """White acceleration over `dt` (Bar-Shalom et al. 2001, 6.3.2), and a random walk of yaw and its drift."""
        s = self.settings
        q = np.zeros((_STATES, _STATES))
        a = s.acceleration_mps2**2
        for p, v in ((0, 3), (1, 4)):
            q[p, p], q[p, v], q[v, p], q[v, v] = a * dt**4 / 4, a * dt**3 / 2, a * dt**3 / 2, a * dt**2
        q[2, 2] = ((s.yaw_rate_rad_s if yaw_known else s.yaw_rate_blind_rad_s) * dt) ** 2
        q[5, 5] = (s.yaw_drift_rad_s2 * dt) ** 2
        return q

    def update_odometry(self, pose: Pose, covariance: NDArray[np.float64] | None = None) -> str | None:
        """Fuse an odometry pose (map frame) with `covariance` `[3, 3]` of x, y, yaw; None takes the settings'.

        Returns None when it was fused, or the reason why the gate refused it.
        """
        s, f = self.settings, self._filter
        if covariance is None:
            covariance = np.diag([s.odometry_position_m**2] * 2 + [s.odometry_yaw_rad**2])
        z = np.array(pose, dtype=np.float64)
        if not (np.isfinite(z).all() and np.isfinite(covariance).all()):
            return self._refuse("odometry is not finite")
        innovation = _residual(z, f.x[:3])
        try:
            square = float(innovation @ np.linalg.solve(f.P[:3, :3] + covariance, innovation))
        except np.linalg.LinAlgError:
            square = math.nan
        if not 0.0 <= square < math.inf:  # rounding, or a covariance that is none, made it meaningless
            return self._refuse("odometry's distance from the estimate cannot be told")
        distance = math.sqrt(square)
        if distance > s.gate:
            off = math.hypot(innovation[0], innovation[1])
            return self._refuse(
                f"odometry is {distance:.1f} deviations off: {off:.2f} m, {math.degrees(innovation[2]):.0f} degrees"
            )
        f.update(z, lambda x: _H, lambda x: x[:3], R=covariance, residual=_residual)
        f.x[2] = wrap_angle(f.x[2])
        self.refused_in_a_row = 0
        return None

    def _refuse(self, reason: str) -> str:
        self.refused_in_a_row += 1
        return f"{reason} ({self.refused_in_a_row} in a row)"

    @property
    def estimate(self) -> Estimate:
        """The current estimate."""
        x = self._filter.x
        return Estimate(
            stamp=self._stamp if self._stamp is not None else 0.0,
            pose=Pose(float(x[0]), float(x[1]), float(x[2])),
            velocity=(float(x[3]), float(x[4])),
            yaw_rate=self._yaw_rate,
            variance=np.diag(self._filter.P)[:5].copy(),
        )


def _residual(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    out = np.subtract(a, b)
    out[2] = wrap_angle(float(out[2]))
    return out
