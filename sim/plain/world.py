"""Physics and LiDAR of one world in a pymunk space of its own, through pymunk's Python interface."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pymunk
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.frames import Pose
from imagine.core.lidar import LidarSpec
from imagine.core.vehicle_limits import VehicleLimits
from imagine.sim.level import Level

TICK_S = 0.1
"""Simulated time of one step: one LiDAR turn."""
_SUBSTEPS = 5
_MASS_KG = 0.087  # DJI Tello
_DRONE, _WALL = 1, 2
_WALL_CATEGORY = 1 << 31  # bit i is drone i


class PlainWorld:
    """One level with drones in it: `poses` and `velocity` `[drones, 3]`, in metres, radians and seconds, map frame.

    `velocity` holds (vx, vy, yaw rate); `contacts` counts, per drone, the walls and drones it has begun to touch.
    """

    def __init__(self, level: Level, poses: Sequence[Pose], lidar: LidarSpec, limits: VehicleLimits) -> None:
        """Put drones at rest at `poses`. Raises InputError for a level with people or crates, which this lacks."""
        if level.people or level.crates:
            raise InputError(f"level {level.name}: the plain world has no people and no crates: name a level without")
        self.level, self.lidar, self.limits = level, lidar, limits
        self.poses = np.array(poses, float)
        self.velocity = np.zeros((len(poses), 3))
        self.contacts = np.zeros(len(poses), np.int64)
        self.space = pymunk.Space()
        self.space.iterations = 10
        self.space.collision_slop = 0.0005  # metres; the default is made for pixels
        self.space.collision_bias = 1e-15  # half of an overlap is gone after a substep
        self.space.on_collision(_DRONE, None, begin=self._begin_contact)
        self.space.add(*self._walls())
        self.bodies = [self._add_drone(drone) for drone in range(len(poses))]

    def _walls(self) -> list[pymunk.Shape]:
        ground = self.space.static_body
        shapes: list[pymunk.Shape] = []
        for loop in (self.level.outline, *self.level.solids):
            corners = [(float(x), float(y)) for x, y in loop]
            for a, b in zip(corners, [*corners[1:], corners[0]], strict=True):
                shapes.append(pymunk.Segment(ground, a, b, 0.0))
        for polygon in self.level.polygons:
            shapes.append(pymunk.Poly(ground, [(float(x), float(y)) for x, y in polygon]))
        for x, y, radius in self.level.circles:
            shapes.append(pymunk.Circle(ground, float(radius), (float(x), float(y))))
        for shape in shapes:
            shape.friction, shape.elasticity, shape.collision_type = 0.0, 0.0, _WALL
            shape.filter = pymunk.ShapeFilter(categories=_WALL_CATEGORY)
        return shapes

    def _add_drone(self, drone: int) -> pymunk.Body:
        body = pymunk.Body(_MASS_KG, float("inf"))  # yaw is not the solver's: discs without friction never turn
        body.position = float(self.poses[drone, 0]), float(self.poses[drone, 1])
        disc = pymunk.Circle(body, self.limits.radius_m)
        disc.friction, disc.elasticity, disc.collision_type = 0.0, 0.0, _DRONE
        disc.filter = pymunk.ShapeFilter(categories=1 << drone)
        self.space.add(body, disc)
        return body

    def _begin_contact(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: object) -> None:
        for shape in arbiter.shapes:
            if shape.collision_type == _DRONE and shape.body is not None:
                self.contacts[self.bodies.index(shape.body)] += 1

    def set_velocity(self, velocity: NDArray[np.float64]) -> None:
        """Let the drones move with `velocity` `[drones, 3]` from now on."""
        self.velocity[...] = velocity
        for body, (vx, vy, _) in zip(self.bodies, velocity.tolist(), strict=True):
            body.velocity = vx, vy

    def step(self, setpoints: NDArray[np.float64]) -> None:
        """Fly one tick with body-frame velocity setpoints `[drones, 3]` (forward, left, yaw rate)."""
        dt = TICK_S / _SUBSTEPS
        yaws = self.poses[:, 2].tolist()
        rates = self.velocity[:, 2].tolist()
        wanted = setpoints.tolist()
        for _ in range(_SUBSTEPS):
            for drone, body in enumerate(self.bodies):
                # Forces, not velocities: the solver then stops what pushes into a wall before positions move.
                body.force, rates[drone] = self._control(body.velocity, yaws[drone], rates[drone], wanted[drone], dt)
                yaws[drone] += rates[drone] * dt
            self.space.step(dt)
        for drone, body in enumerate(self.bodies):
            yaw = math.remainder(yaws[drone], 2.0 * math.pi)
            self.poses[drone] = body.position.x, body.position.y, yaw
            self.velocity[drone] = body.velocity.x, body.velocity.y, rates[drone]

    def _control(
        self, velocity: pymunk.Vec2d, yaw: float, yaw_rate: float, wanted: list[float], dt: float
    ) -> tuple[tuple[float, float], float]:
        """Return the force (N) that moves a drone's velocity toward its setpoint, and its next yaw rate."""
        limits = self.limits
        blend = 1.0 - math.exp(-dt / limits.lag_s) if limits.lag_s > 0.0 else 1.0
        forward, left, turn = wanted
        speed = math.hypot(forward, left)
        if speed > limits.speed_mps:
            forward, left = forward * limits.speed_mps / speed, left * limits.speed_mps / speed
        c, s = math.cos(yaw), math.sin(yaw)
        ax = (c * forward - s * left - velocity.x) * blend / dt
        ay = (s * forward + c * left - velocity.y) * blend / dt
        size = math.hypot(ax, ay)
        if size > limits.acceleration_mps2:
            ax, ay = ax * limits.acceleration_mps2 / size, ay * limits.acceleration_mps2 / size
        turn = min(max(turn, -limits.yaw_rate_rps), limits.yaw_rate_rps)
        return (_MASS_KG * ax, _MASS_KG * ay), yaw_rate + (turn - yaw_rate) * blend

    def scan(self, generator: np.random.Generator) -> NDArray[np.float32]:
        """Return a turn of every drone's LiDAR, float32 `[drones, beams]`: walls, posts and other drones.

        Ranges in metres with the sensor's noise; inf no return, nan below the least range.
        """
        lidar = self.lidar
        ranges = self.exact_ranges()
        ranges += generator.normal(0.0, lidar.noise_std, ranges.shape)
        ranges[ranges > lidar.range_max] = np.inf
        ranges[ranges < lidar.range_min] = np.nan
        return ranges.astype(np.float32)

    def exact_ranges(self) -> NDArray[np.float64]:
        """Return the distance to the first thing on each beam, metres, `[drones, beams]`; inf beyond the reach."""
        reach = self.lidar.range_max
        query = self.space.segment_query_first
        ranges = np.full((len(self.bodies), self.lidar.beams), np.inf)
        for drone, (x, y, yaw) in enumerate(self.poses.tolist()):
            others = pymunk.ShapeFilter(mask=pymunk.ShapeFilter.ALL_MASKS() ^ (1 << drone))
            bearings = self.lidar.bearings + yaw
            ends = np.column_stack((x + reach * np.cos(bearings), y + reach * np.sin(bearings))).tolist()
            for beam, end in enumerate(ends):
                hit = query((x, y), end, 0.0, others)
                if hit is not None:
                    ranges[drone, beam] = hit.alpha * reach
        return ranges
