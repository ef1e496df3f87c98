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
from imagine.sim.dynamics import SUBSTEP_S, SUBSTEPS, DynamicsSettings
from imagine.sim.level import Level
from imagine.sim.physics import APART_SUBSTEPS, DRONES, NEVER, WALLS
from imagine.sim.twin import Twin

_MASS_KG = DynamicsSettings.model_fields["mass_kg"].default
_WALL, _DRONE = 1, 2
_WALL_CATEGORY = 1 << 31  # bit i is drone i
_NOISE_REACH = 6.0  # standard deviations: what lies further beyond the reach is never measured within it


class PlainWorld:
    """One level with drones in it: `poses` and `velocity` `[drones, 3]`, in metres, radians and seconds, map frame.

    `velocity` holds (vx, vy, yaw rate). `contacts` int64 `[2, drones]` counts how often each drone began to touch a
    wall, and another drone; a touch within 0.2 s of the last of its kind belongs to the same contact. The drones that
    `alive` leaves out have fallen: they neither move nor are they seen.
    """

    def __init__(
        self,
        level: Level,
        poses: Sequence[Pose],
        lidar: LidarSpec,
        limits: VehicleLimits,
        reach_m: float | None = None,
    ) -> None:
        """Put drones at rest at `poses`; returns past `reach_m` (default: the sensor's reach) are not wanted.

        Raises InputError for a level with people or crates, which this lacks.
        """
        if level.people or level.crates:
            raise InputError(f"level {level.name}: the plain world has no people and no crates: name a level without")
        self.level, self.lidar, self.limits = level, lidar, limits
        self.reach_m = lidar.range_max if reach_m is None else min(reach_m, lidar.range_max)
        self.poses = np.array(poses, float)
        self.velocity = np.zeros((len(poses), 3))
        self.alive = np.ones(len(poses), np.bool_)
        self.contacts = np.zeros((2, len(poses)), np.int64)
        self.last_touch = np.full((2, len(poses)), NEVER, np.int64)
        """The substep in which each drone last touched a wall, and another drone."""
        self.substeps = 0
        self.space = pymunk.Space()
        self.space.iterations = 10
        self.space.collision_slop = 0.0005  # metres; the default is made for pixels
        self.space.collision_bias = 1e-15  # half of an overlap is gone after a substep
        self.bodies = [self._add_drone(drone) for drone in range(len(poses))]
        self.space.add(*self._walls())
        for kind, other in enumerate((_WALL, _DRONE)):
            self.space.on_collision(_DRONE, other, pre_solve=self._touch, data=kind)

    def _walls(self) -> list[pymunk.Shape]:
        ground = self.space.static_body
        shapes: list[pymunk.Shape] = []
        for loop in (self.level.outline, *self.level.solids):
            corners = [(float(x), float(y)) for x, y in loop]
            for k, corner in enumerate(corners):
                following, before, after = (corners[(k + i) % len(corners)] for i in (1, -1, 2))
                edge = pymunk.Segment(ground, corner, following, 0.0)
                edge.set_neighbors(before, after)  # nothing catches on the joints of a loop
                shapes.append(edge)
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

    def _touch(self, arbiter: pymunk.Arbiter, space: pymunk.Space, kind: int) -> None:
        """Take note of two shapes that touch: the solver calls this in every substep that they do."""
        for body in arbiter.bodies:
            if body is self.space.static_body:
                continue
            drone = self.bodies.index(body)
            if self.substeps - self.last_touch[kind, drone] > APART_SUBSTEPS:
                self.contacts[kind, drone] += 1
            self.last_touch[kind, drone] = self.substeps

    def set_velocity(self, velocity: NDArray[np.float64]) -> None:
        """Let the drones move with `velocity` `[drones, 3]` from now on."""
        self.velocity[...] = velocity
        for body, (vx, vy, _) in zip(self.bodies, velocity.tolist(), strict=True):
            body.velocity = vx, vy

    def take_over(self, twin: Twin, world: int) -> None:
        """Move on as a twin's world does, with the contacts it has counted."""
        self.set_velocity(twin.velocity[world])
        self.substeps = int(twin._ages[world]) * SUBSTEPS
        kinds = [WALLS, DRONES]
        self.contacts[...], self.last_touch[...] = twin._counts[kinds, world], twin._last_touch[kinds, world]
        self.keep(twin.alive[world])

    def keep(self, alive: NDArray[np.bool_]) -> None:
        """Let those fall that are not `alive` (bool `[drones]`): they stop and are out of everyone's way."""
        for drone in np.flatnonzero(self.alive & ~alive).tolist():
            self.space.remove(self.bodies[drone], *self.bodies[drone].shapes)
            self.velocity[drone] = 0.0
        self.alive &= alive

    def step(self, setpoints: NDArray[np.float64]) -> None:
        """Fly one tick with body-frame velocity setpoints `[drones, 3]` (forward, left, yaw rate)."""
        flying = np.flatnonzero(self.alive).tolist()
        yaws = self.poses[:, 2].tolist()
        rates = self.velocity[:, 2].tolist()
        wanted = setpoints.tolist()
        for _ in range(SUBSTEPS):
            for drone in flying:
                body = self.bodies[drone]
                # Forces, not velocities: the solver then stops what pushes into a wall before positions move.
                body.force, rates[drone] = self._control(body.velocity, yaws[drone], rates[drone], wanted[drone])
                yaws[drone] += rates[drone] * SUBSTEP_S
            self.space.step(SUBSTEP_S)
            self.substeps += 1
        for drone in flying:
            body = self.bodies[drone]
            yaw = (yaws[drone] + math.pi) % (2.0 * math.pi) - math.pi
            self.poses[drone] = body.position.x, body.position.y, yaw
            self.velocity[drone] = body.velocity.x, body.velocity.y, rates[drone]

    def _control(
        self, velocity: pymunk.Vec2d, yaw: float, yaw_rate: float, wanted: list[float]
    ) -> tuple[tuple[float, float], float]:
        """Return the force (N) that moves a drone's velocity toward its setpoint, and its next yaw rate."""
        limits = self.limits
        blend = 1.0 - math.exp(-SUBSTEP_S / limits.lag_s) if limits.lag_s > 0.0 else 1.0
        forward, left, turn = wanted
        speed = math.hypot(forward, left)
        if speed > limits.speed_mps:
            forward, left = forward * limits.speed_mps / speed, left * limits.speed_mps / speed
        c, s = math.cos(yaw), math.sin(yaw)
        ax = (c * forward - s * left - velocity.x) * blend / SUBSTEP_S
        ay = (s * forward + c * left - velocity.y) * blend / SUBSTEP_S
        size = math.hypot(ax, ay)
        if size > limits.acceleration_mps2:
            ax, ay = ax * limits.acceleration_mps2 / size, ay * limits.acceleration_mps2 / size
        turn = min(max(turn, -limits.yaw_rate_rps), limits.yaw_rate_rps)
        return (_MASS_KG * ax, _MASS_KG * ay), yaw_rate + (turn - yaw_rate) * blend

    def scan(self, generator: np.random.Generator) -> NDArray[np.float32]:
        """Return a turn of every drone's LiDAR, float32 `[drones, beams]`: walls, posts and other drones.

        Ranges in metres with the sensor's noise; inf no return within reach, nan below the least range. Those of
        fallen drones are nan.
        """
        ranges = self.exact_ranges()
        ranges += generator.normal(0.0, self.lidar.noise_std, ranges.shape)
        ranges[ranges > self.reach_m] = np.inf
        ranges[ranges < self.lidar.range_min] = np.nan
        ranges[~self.alive] = np.nan
        return ranges.astype(np.float32)

    def exact_ranges(self) -> NDArray[np.float64]:
        """Return the distance to the first thing on each beam, metres, `[drones, beams]`; inf beyond the reach."""
        reach = min(self.lidar.range_max, self.reach_m + _NOISE_REACH * self.lidar.noise_std)
        query = self.space.segment_query_first
        ranges = np.full((len(self.bodies), self.lidar.beams), np.inf)
        for drone in np.flatnonzero(self.alive).tolist():
            x, y, yaw = self.poses[drone].tolist()
            others = pymunk.ShapeFilter(mask=pymunk.ShapeFilter.ALL_MASKS() ^ (1 << drone))
            bearings = self.lidar.bearings + yaw
            ends = np.column_stack((x + reach * np.cos(bearings), y + reach * np.sin(bearings))).tolist()
            for beam, end in enumerate(ends):
                hit = query((x, y), end, 0.0, others)
                if hit is not None:
                    ranges[drone, beam] = hit.alpha * reach
        return ranges
