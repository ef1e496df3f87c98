"""The arithmetic of one drone, by two means: numpy and plain Python, or the project's compiled functions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from imagine.core import action, frontier, observation, raster, shield
from imagine.core.contract import ActionSpec
from imagine.core.frames import Pose
from imagine.core.frontier import FrontierField
from imagine.core.lidar import LidarSpec, Scan
from imagine.core.observation_spec import ObservationSpec
from imagine.core.raster import LIMIT, TILE
from imagine.core.vehicle_limits import VehicleLimits
from imagine.sim.plain.evidence import integrate_scan
from imagine.sim.plain.field import Ways, frontier_field
from imagine.sim.plain.steering import body_velocity, intent, shielded
from imagine.sim.plain.views import motion, sectors, views

Intent = tuple[float, ...]
Setpoint = tuple[float, float, float]


class Means(Protocol):
    """What a drone computes in a tick; grids have their first cell at `origin` (column, row), in map cells."""

    def decide(self, numbers: NDArray[np.float32], spec: ActionSpec, axes: action.Axes, pose: Pose) -> Intent:
        """Return the intent of an action taken at `pose`."""

    def setpoint(
        self, wanted: Intent, spec: ActionSpec, axes: action.Axes, pose: Pose, ranges: NDArray[np.float32],
        lidar: LidarSpec, limits: VehicleLimits,
    ) -> Setpoint:  # fmt: skip
        """Return the body velocity (m/s, m/s, rad/s) that an intent asks for now, shielded by the newest scan."""

    def draw(
        self, cells: NDArray[np.int8], origin: tuple[int, int], pose: Pose, ranges: NDArray[np.float32],
        lidar: LidarSpec, range_cap_m: float,
    ) -> tuple[int, NDArray[np.bool_]]:  # fmt: skip
        """Add a scan to a layer, in place; return how many cells changed, and which tiles."""

    def belief(self, layers: Sequence[NDArray[np.int8]]) -> NDArray[np.int8]:
        """Return the clamped sum of layers."""

    def field(self, belief: NDArray[np.int8]) -> FrontierField:
        """Return the frontier field of a belief."""

    def observe(
        self, spec: ObservationSpec, belief: NDArray[np.int8], field: FrontierField, origin: tuple[int, int],
        pose: Pose, velocity: NDArray[np.float64], ranges: NDArray[np.float32], lidar: LidarSpec,
    ) -> dict[str, NDArray[np.float32]]:  # fmt: skip
        """Return what a policy sees, named and shaped as `spec.shapes`."""


class NumpyMeans:
    """Numpy and plain Python; `ways` finds the cheapest ways to frontiers."""

    def __init__(self, ways: Ways) -> None:
        self._ways = ways

    def decide(self, numbers: NDArray[np.float32], spec: ActionSpec, axes: action.Axes, pose: Pose) -> Intent:
        """Return the intent of an action taken at `pose`."""
        return intent(numbers, spec, axes == "map", pose)

    def setpoint(
        self, wanted: Intent, spec: ActionSpec, axes: action.Axes, pose: Pose, ranges: NDArray[np.float32],
        lidar: LidarSpec, limits: VehicleLimits,
    ) -> Setpoint:  # fmt: skip
        """Return the body velocity (m/s, m/s, rad/s) that an intent asks for now, shielded by the newest scan."""
        vx, vy, rate = body_velocity(wanted, spec, axes == "map", pose)
        return *shielded(vx, vy, ranges, lidar, limits), rate

    def draw(
        self, cells: NDArray[np.int8], origin: tuple[int, int], pose: Pose, ranges: NDArray[np.float32],
        lidar: LidarSpec, range_cap_m: float,
    ) -> tuple[int, NDArray[np.bool_]]:  # fmt: skip
        """Add a scan to a layer, in place; return how many cells changed, and which tiles."""
        return integrate_scan(cells, origin, pose, ranges, lidar, range_cap_m)

    def belief(self, layers: Sequence[NDArray[np.int8]]) -> NDArray[np.int8]:
        """Return the clamped sum of layers."""
        return np.clip(np.sum(layers, axis=0, dtype=np.int16), -LIMIT, LIMIT).astype(np.int8)

    def field(self, belief: NDArray[np.int8]) -> FrontierField:
        """Return the frontier field of a belief."""
        return frontier_field(belief, self._ways)

    def observe(
        self, spec: ObservationSpec, belief: NDArray[np.int8], field: FrontierField, origin: tuple[int, int],
        pose: Pose, velocity: NDArray[np.float64], ranges: NDArray[np.float32], lidar: LidarSpec,
    ) -> dict[str, NDArray[np.float32]]:  # fmt: skip
        """Return what a policy sees, named and shaped as `spec.shapes`."""
        turn = pose.yaw if spec.axes == "heading" else 0.0
        return {
            "views": views(spec, belief, field.cost, origin, (pose.x, pose.y), turn),
            "lidar": sectors(ranges, lidar, pose.yaw - turn, spec.lidar_sectors, spec.lidar_range_m),
            "motion": motion(spec, velocity, turn),
        }


class KernelMeans:
    """The functions that fly on one drone: compiled, but called drone by drone."""

    def decide(self, numbers: NDArray[np.float32], spec: ActionSpec, axes: action.Axes, pose: Pose) -> Intent:
        """Return the intent of an action taken at `pose`."""
        return action.to_intent(numbers, spec, axes, pose)

    def setpoint(
        self, wanted: Intent, spec: ActionSpec, axes: action.Axes, pose: Pose, ranges: NDArray[np.float32],
        lidar: LidarSpec, limits: VehicleLimits,
    ) -> Setpoint:  # fmt: skip
        """Return the body velocity (m/s, m/s, rad/s) that an intent asks for now, shielded by the newest scan."""
        a, b, c = wanted
        vx, vy, rate = action.intended_velocity((a, b, c), spec, axes, pose)
        return *shield.shield_velocity(vx, vy, Scan(0.0, ranges), lidar, limits), rate

    def draw(
        self, cells: NDArray[np.int8], origin: tuple[int, int], pose: Pose, ranges: NDArray[np.float32],
        lidar: LidarSpec, range_cap_m: float,
    ) -> tuple[int, NDArray[np.bool_]]:  # fmt: skip
        """Add a scan to a layer, in place; return how many cells changed, and which tiles."""
        touched = np.zeros((cells.shape[0] // TILE, cells.shape[1] // TILE), np.bool_)
        changed = raster.integrate_scan(
            cells, touched, *origin, *pose, lidar.start, lidar.increment, ranges, lidar.range_min, range_cap_m
        )
        return changed, touched

    def belief(self, layers: Sequence[NDArray[np.int8]]) -> NDArray[np.int8]:
        """Return the clamped sum of layers."""
        out = np.empty(layers[0].shape, np.int8)
        raster.sum_layers(np.stack(layers), out)
        return out

    def field(self, belief: NDArray[np.int8]) -> FrontierField:
        """Return the frontier field of a belief."""
        return frontier.frontier_field(belief)

    def observe(
        self, spec: ObservationSpec, belief: NDArray[np.int8], field: FrontierField, origin: tuple[int, int],
        pose: Pose, velocity: NDArray[np.float64], ranges: NDArray[np.float32], lidar: LidarSpec,
    ) -> dict[str, NDArray[np.float32]]:  # fmt: skip
        """Return what a policy sees, named and shaped as `spec.shapes`."""
        vx, vy, rate = velocity.tolist()
        return observation.observe(spec, belief, field, origin, pose, (vx, vy), rate, Scan(0.0, ranges), lidar)
