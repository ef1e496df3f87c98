"""LiDAR odometry: kiss-icp's point-to-point ICP on planar scans, started from the autopilot's yaw.

The stages are those of KISS-ICP (Vizzo et al. 2023), taken apart so that a yaw prior can enter the initial guess, and
so that a match that cannot be right is refused *before* it spoils the local map.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from kiss_icp.mapping import VoxelHashMap
from kiss_icp.registration import Registration
from kiss_icp.voxelization import voxel_down_sample
from numpy.typing import NDArray
from scipy.spatial import KDTree

from imagine.core.frames import IDENTITY, Pose, compose, relative, transform_points, wrap_angle
from imagine.core.lidar import LidarSpec, Scan, points
from imagine.onboard.deskewing import deskewed_points
from imagine.onboard.odometry_settings import OdometrySettings


class OdometryResult(NamedTuple):
    """One step of odometry: `pose` in the map frame, `delta` since the last scan, in the frame of the previous pose.

    `points_used` counts the thinned points that were matched; `overlap` is the share of the scan's returns that meet
    the last scan used. Where `ok` is false the scan was not used, `pose` is a prediction, and `reason` says why.
    """

    pose: Pose
    delta: Pose
    ok: bool
    points_used: int
    overlap: float
    reason: str | None = None


class LidarOdometry:
    """Tracks a LiDAR's pose scan by scan. Deterministic: ICP runs in one thread, so sums come out the same each time.

    The first scan must have enough points; it founds the local map at the launch pose.
    """

    def __init__(self, spec: LidarSpec, settings: OdometrySettings | None = None, launch: Pose = IDENTITY) -> None:
        """Start at `launch` in the map frame with an empty local map."""
        self.spec = spec
        self.settings = settings or OdometrySettings()
        self.pose = launch
        s = self.settings
        self._registration = Registration(s.max_iterations, s.convergence, max_num_threads=1)
        self._map = VoxelHashMap(s.voxel_m, s.map_radius_m, s.points_per_voxel)
        self._last_used: KDTree | None = None
        self._motion = IDENTITY
        self._stamp: float | None = None
        self._yaw_prior: float | None = None

    def update(self, scan: Scan, yaw_prior: float | None = None) -> OdometryResult:
        """Match a scan against the local map and return the new pose.

        `yaw_prior` is the autopilot's yaw at the scan's stamp, radians counter-clockwise, from any origin: only its
        increments are used. Nothing raises: a scan that cannot be matched gives `ok` false and a reason.
        """
        motion = self._predicted_motion(yaw_prior)
        cloud = points(scan, self.spec)
        if self.settings.deskew:
            cloud = deskewed_points(scan, self.spec, motion, self.settings.clockwise)
        source = _thin(cloud, self.settings.source_voxel_m)
        guess = compose(self.pose, motion)
        elapsed = 0.0 if self._stamp is None else scan.stamp - self._stamp

        if len(source) < self.settings.min_points:
            reason: str | None = (
                f"too few returns: {len(cloud)} of {len(scan.ranges)} beams, "
                f"{len(source)} after thinning, needs {self.settings.min_points}"
            )
            pose, overlap = guess, 0.0
        elif self._last_used is None:
            pose, overlap, reason = self.pose, 1.0, None
        else:
            pose = self._match(source, guess)
            overlap = self._overlap(cloud, pose)
            reason = self._why_wrong(pose, guess, overlap, elapsed, yaw_prior is not None)

        if reason is None:
            world = transform_points(pose, cloud)
            self._map.update(_lift(cloud), _matrix(pose))
            self._last_used = KDTree(world)
            self._motion = relative(self.pose, pose)
        else:
            # a refused scan: go on as before, but ever slower, so that a lost track does not run away
            pose, self._motion = guess, Pose(self._motion.x / 2.0, self._motion.y / 2.0, self._motion.yaw / 2.0)
        delta = relative(self.pose, pose)
        self.pose, self._stamp = pose, scan.stamp
        self._yaw_prior = yaw_prior if yaw_prior is not None else self._yaw_prior
        return OdometryResult(pose, delta, reason is None, len(source), overlap, reason)

    def _predicted_motion(self, yaw_prior: float | None) -> Pose:
        """Constant velocity (better than none: 0.06 m against 0.11 m on Freiburg 079), turned as the prior says."""
        if yaw_prior is None or self._yaw_prior is None:
            return self._motion
        return Pose(self._motion.x, self._motion.y, wrap_angle(yaw_prior - self._yaw_prior))

    def _match(self, source: NDArray[np.float64], guess: Pose) -> Pose:
        threshold = self.settings.threshold_m
        matched = self._registration.align_points_to_map(
            _lift(source), self._map, _matrix(guess), max_correspondance_distance=3.0 * threshold, kernel=threshold
        )
        return _pose(matched)

    def _overlap(self, cloud: NDArray[np.float64], pose: Pose) -> float:
        """Return the share of the scan's points that lie near a point of the last scan used."""
        if self._last_used is None or not all(map(math.isfinite, pose)):
            return 0.0
        reach = self.settings.overlap_distance_m
        distance, _ = self._last_used.query(transform_points(pose, cloud), distance_upper_bound=reach)
        return float(np.mean(np.isfinite(distance)))

    def _why_wrong(self, pose: Pose, guess: Pose, overlap: float, elapsed_s: float, has_prior: bool) -> str | None:
        s = self.settings
        if not all(map(math.isfinite, pose)):
            return "the match is not finite"
        moved = math.hypot(pose.x - self.pose.x, pose.y - self.pose.y)
        if moved > s.max_speed_mps * max(elapsed_s, 1.0 / self.spec.rate_hz):
            return f"the match moves {moved:.2f} m in {elapsed_s:.2f} s"
        corrected = math.hypot(pose.x - guess.x, pose.y - guess.y)
        if corrected > s.max_correction_m:
            return f"the match lies {corrected:.2f} m from where the motion leads, over {s.max_correction_m} m"
        turned = abs(wrap_angle(pose.yaw - guess.yaw))
        if has_prior and turned > s.max_yaw_error_rad:
            return f"the match turns {math.degrees(turned):.0f} degrees away from the autopilot's yaw"
        if overlap < s.min_overlap:
            return f"only {overlap:.0%} of the scan meets the last one, needs {s.min_overlap:.0%}"
        return None


def _thin(cloud: NDArray[np.float64], voxel_m: float) -> NDArray[np.float64]:
    """Keep one point `[n, 2]` of each voxel."""
    if len(cloud) == 0:
        return cloud
    thinned: NDArray[np.float64] = voxel_down_sample(_lift(cloud), voxel_m)
    return thinned[:, :2]


def _lift(planar: NDArray[np.float64]) -> NDArray[np.float64]:
    """Put planar points `[n, 2]` at height zero, `[n, 3]`, as kiss-icp wants them."""
    return np.column_stack((planar, np.zeros(len(planar))))


def _matrix(pose: Pose) -> NDArray[np.float64]:
    c, s = math.cos(pose.yaw), math.sin(pose.yaw)
    return np.array([[c, -s, 0.0, pose.x], [s, c, 0.0, pose.y], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def _pose(matrix: NDArray[np.float64]) -> Pose:
    return Pose(float(matrix[0, 3]), float(matrix[1, 3]), math.atan2(matrix[1, 0], matrix[0, 0]))
