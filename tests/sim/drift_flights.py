"""Flights that tell how the odometry that flies drifts: the twin, the vehicle's gyro, and the real perception.

As a script it flies all that `sim/odometry_drift.py` is fitted to, prints the constants, and compares:
`python tests/sim/drift_flights.py` (48 flights of 1000 ticks with three drones, about five minutes).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose, rotate, wrap_angle
from imagine.core.frontier import frontier_field
from imagine.core.lidar import LD19, Scan
from imagine.core.planner import plan_velocity
from imagine.core.shield import shield_velocity
from imagine.core.vehicle_limits import VehicleLimits
from imagine.onboard.odometry_settings import OdometrySettings
from imagine.onboard.perception import Perception, PerceptionSettings
from imagine.onboard.records import Telemetry
from imagine.onboard.yaw_prior import YawPrior
from imagine.sim.flight_control import VehicleSettings
from imagine.sim.level import load_level
from imagine.sim.lidar_model import LidarModel
from imagine.sim.odometry_drift import Track, fit, pose_errors, replayed, rms_error
from imagine.sim.sensing import Sensing
from imagine.sim.twin import TICK_S, Twin
from imagine.sim.vehicle_estimate import ExternalPose, VehicleEstimate
from imagine.sim.workers import Workers

LIMITS = VehicleLimits()
MAP_REACH_M = 4.0


class Navigator:
    """One drone: perception as the runner does it, the vehicle's gyro, and the frontier planner on its own map."""

    def __init__(self, launch: Pose, turning: bool, deskew: bool, rng: np.random.Generator) -> None:
        vehicle = VehicleSettings()
        settings = PerceptionSettings(odometry=OdometrySettings(deskew=deskew))
        self.perception = Perception(LD19, settings, launch)
        self.prior = YawPrior(LIMITS.yaw_rate_rps)
        self.vehicle = VehicleEstimate(launch.yaw)
        self.evidence = EvidenceMap(1)
        self.turning, self.rng = turning, rng
        self.gyro_bias = rng.normal(0.0, vehicle.gyro_bias_std_rps)
        self.gyro_noise = vehicle.gyro_noise_std_rps
        self.course = 0.0
        self.refused = 0

    def tick(
        self, stamp: float, ranges: NDArray[np.float32], yaw_rate: float
    ) -> tuple[Pose, tuple[float, float, float]]:
        """Take a scan and the true yaw rate since the last; return the estimated pose and the body setpoint."""
        measured = yaw_rate + self.gyro_bias + self.rng.normal(0.0, self.gyro_noise)
        self.vehicle.propagate(measured, TICK_S)
        telemetry = Telemetry(stamp=stamp, yaw=self.vehicle.yaw, yaw_rate=measured)
        scan = Scan(stamp, np.round(ranges, 3).astype(np.float32))  # the datagram carries whole millimetres
        where = self.perception.update(scan, self.prior.at(stamp, telemetry))
        self.vehicle.fuse(ExternalPose(*where.pose, *where.velocity, resets=0))
        if where.ok:
            self.evidence.integrate(where.pose, scan, LD19, MAP_REACH_M)
        else:
            self.refused += 1
        return where.pose, self._setpoint(scan, where.pose)

    def _setpoint(self, scan: Scan, pose: Pose) -> tuple[float, float, float]:
        field = frontier_field(self.evidence.belief())
        planned = plan_velocity(field, self.evidence.origin_cells, pose, scan, LD19, LIMITS.speed_mps)
        if planned is None:  # all is explored: wander
            if self.rng.random() < 0.05:
                self.course = self.rng.uniform(-math.pi, math.pi)
            planned = 0.6 * math.cos(self.course), 0.6 * math.sin(self.course)
        vx, vy = shield_velocity(*rotate(-pose.yaw, *planned), scan, LD19, LIMITS)
        turn = 0.0
        if self.turning:  # look where it goes, as a policy that steers by its heading does
            wanted = wrap_angle(math.atan2(planned[1], planned[0]) - pose.yaw)
            turn = float(np.clip(3.0 * wanted, -LIMITS.yaw_rate_rps, LIMITS.yaw_rate_rps))
        return vx, vy, turn - self.gyro_bias  # the vehicle holds the rate that its gyro shows


def fly(
    level_name: str, seed: int, ticks: int, turning: bool, skew: bool = False, deskew: bool = False, drones: int = 3
) -> tuple[list[Track], int]:
    """Fly a team through a level; return each drone's true and estimated poses `[ticks, 3]`, and the scans refused.

    `turning` drones look where they go; `skew` is of the LiDAR, `deskew` of the odometry.
    """
    level = load_level(level_name)
    twin = Twin([level], drones, LD19, LIMITS, seed)
    sensing = Sensing(1, drones, LD19, seed, Workers(1), model=LidarModel(skew=skew))
    sensing.set_level(0, level)
    pilots = [
        Navigator(Pose(*twin.poses[0, k]), turning, deskew, np.random.default_rng([seed, k])) for k in range(drones)
    ]
    true, estimated = np.empty((drones, ticks, 3)), np.empty((drones, ticks, 3))
    yaw_before = twin.poses[0, :, 2].copy()
    for tick in range(ticks):
        ranges = sensing.scan(twin.poses, twin.velocity, LIMITS.radius_m, tick)[0]
        setpoints = np.zeros((1, drones, 3))
        for k, pilot in enumerate(pilots):
            yaw = float(twin.poses[0, k, 2])
            pose, setpoints[0, k] = pilot.tick(TICK_S * (tick + 1), ranges[k], wrap_angle(yaw - yaw_before[k]) / TICK_S)
            true[k, tick], estimated[k, tick] = twin.poses[0, k], pose
            yaw_before[k] = yaw
        twin.step(setpoints)
    return list(zip(true, estimated, strict=True)), sum(pilot.refused for pilot in pilots)


def rms_at(tracks: Sequence[Track], first: int, last: int) -> tuple[float, float]:
    """Return the rms error of position (m) and yaw (degrees) over ticks first to last of all tracks."""
    errors = np.concatenate([pose_errors(true[first:last], estimated[first:last]) for true, estimated in tracks])
    position = math.sqrt((errors[:, :2] ** 2).sum(axis=1).mean())
    return position, math.degrees(math.sqrt((errors[:, 2] ** 2).mean()))


def main() -> None:
    """Fly, fit and print."""
    for skewed in (False, True):
        tracks: list[Track] = []
        refused = 0
        for turning in (False, True):
            for name in "123456":
                for seed in (0, 1):
                    flown, lost = fly(name, seed, 1000, turning, skewed, deskew=skewed)
                    tracks += flown
                    refused += lost
        model = fit(tracks, TICK_S)
        drawn = [track for seed in range(5) for track in replayed(model, tracks, TICK_S, seed)]
        print(
            f"{'skewed scans, deskewed' if skewed else 'instantaneous scans'}: {len(tracks)} tracks, {refused} refused"
        )
        print(f"  {model}")
        for what, group in (("measured", tracks), ("model", drawn)):
            rms = rms_error(group)
            print(f"  {what}: rms {math.sqrt((rms**2).mean()):.4f} m, median flight {np.median(rms):.4f} m")
            for first, last in ((0, 50), (50, 150), (150, 400), (400, 1000)):
                position, yaw = rms_at(group, first, last)
                print(f"    ticks {first}-{last}: {position:.4f} m, {yaw:.3f} degrees")


if __name__ == "__main__":
    main()
