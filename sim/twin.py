"""The twin's physics and sensing: many worlds of drones in one pymunk space, stepped together.

Each drone is a disc with a velocity controller in front of it: what a setpoint asks for is approached with a lag and
a limited acceleration, and walls and other drones push back. Worlds lie far apart in the one space, so they cannot
touch, and positions and velocities move in bulk through `pymunk.batch`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np
import pymunk
import pymunk.batch
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.frames import Pose
from imagine.core.lidar import LD19, LidarSpec
from imagine.core.vehicle_limits import VehicleLimits
from imagine.sim.level import Level
from imagine.sim.sensing import Sensing
from imagine.sim.workers import Workers

TICK_S = 0.1
"""Simulated time of one step: one LiDAR turn."""
_SUBSTEPS = 5
_SPACING_M = 256.0  # between worlds; a power of two keeps positions exact to the same last bit in the same row
_WORLDS_A_ROW = 32
_MASS_KG = 0.087  # DJI Tello
_DRONE, _WALL = 1, 2
_MOTION_FIELDS = pymunk.batch.BodyFields.POSITION | pymunk.batch.BodyFields.VELOCITY
_ARBITER_FIELDS = (
    pymunk.batch.ArbiterFields.BODY_A_ID
    | pymunk.batch.ArbiterFields.BODY_B_ID
    | pymunk.batch.ArbiterFields.IS_FIRST_CONTACT
)


class Twin:
    """Worlds of drones: poses and velocities `[worlds, drones, 3]`, in metres, radians and seconds, map frame.

    `velocity` holds (vx, vy, yaw rate); `contacts` counts, per drone, the walls and drones it has begun to touch.
    """

    dt = TICK_S

    def __init__(
        self,
        levels: Sequence[Level],
        drones: int,
        lidar: LidarSpec = LD19,
        limits: VehicleLimits | None = None,
        seed: int = 0,
    ) -> None:
        """Make one world for each of `levels`, its drones on the level's launch poses."""
        if not levels or drones < 1:
            raise InputError(f"a twin needs at least one world and one drone, got {len(levels)} and {drones}")
        self.worlds, self.drones = len(levels), drones
        self.lidar = lidar
        self.limits = limits or VehicleLimits()
        self.seed = seed
        self.ticks = 0
        self.workers = Workers()
        self.poses = np.zeros((self.worlds, drones, 3))
        self.velocity = np.zeros((self.worlds, drones, 3))
        self.contacts = np.zeros((self.worlds, drones), np.int64)
        self.levels: list[Level] = list(levels)
        self._offsets = np.array(
            [[(w % _WORLDS_A_ROW) * _SPACING_M, (w // _WORLDS_A_ROW) * _SPACING_M] for w in range(self.worlds)]
        )
        self._space = pymunk.Space()
        self._space.iterations = 10
        self._space.collision_slop = 0.0005  # metres; the default is made for pixels
        self._space.collision_bias = 1e-15  # half of an overlap is gone after a substep
        self._statics: list[list[pymunk.Shape]] = [[] for _ in range(self.worlds)]
        self._bodies = self._make_bodies()
        self._index_of = {body.id: index for index, body in enumerate(self._bodies)}
        self._forces = pymunk.batch.Buffer()
        self._motion = pymunk.batch.Buffer()
        self._arbiters = pymunk.batch.Buffer()
        self._sensing = Sensing(self.worlds, drones, lidar, seed, self.workers)
        for world, level in enumerate(levels):
            self.set_level(world, level, level.launch_poses(drones))

    def _make_bodies(self) -> list[pymunk.Body]:
        bodies = []
        for _ in range(self.worlds * self.drones):
            body = pymunk.Body(_MASS_KG, float("inf"))  # yaw is not the solver's: discs without friction never turn
            disc = pymunk.Circle(body, self.limits.radius_m)
            disc.friction, disc.elasticity, disc.collision_type = 0.0, 0.0, _DRONE
            self._space.add(body, disc)
            bodies.append(body)
        return bodies

    def set_level(self, world: int, level: Level, poses: Sequence[Pose]) -> None:
        """Put a world's drones at rest at `poses` in another (or the same) level."""
        if len(poses) != self.drones:
            raise InputError(f"level {level.name}: {len(poses)} launch poses for {self.drones} drones")
        self._space.remove(*self._statics[world])
        offset_x, offset_y = self._offsets[world]
        ground = self._space.static_body
        shapes: list[pymunk.Shape] = []
        loop = [(x + offset_x, y + offset_y) for x, y in level.outline]
        for a, b in zip(loop, [*loop[1:], loop[0]], strict=True):
            shapes.append(pymunk.Segment(ground, a, b, 0.0))
        for polygon in level.polygons:
            shapes.append(pymunk.Poly(ground, [(x + offset_x, y + offset_y) for x, y in polygon]))
        for x, y, radius in level.circles:
            shapes.append(pymunk.Circle(ground, radius, (x + offset_x, y + offset_y)))
        for shape in shapes:
            shape.friction, shape.elasticity, shape.collision_type = 0.0, 0.0, _WALL
        self._space.add(*shapes)
        self._statics[world] = shapes
        self.levels[world] = level
        self._sensing.set_level(world, level)
        self.poses[world] = poses
        self.velocity[world] = 0.0
        self.contacts[world] = 0
        for drone, pose in enumerate(poses):
            body = self._bodies[world * self.drones + drone]
            body.position = (pose.x + offset_x, pose.y + offset_y)
            body.velocity = (0.0, 0.0)

    def step(self, setpoints: NDArray[np.float64]) -> None:
        """Fly one tick with body-frame velocity setpoints `[worlds, drones, 3]` (forward, left, yaw rate).

        Setpoints past the limits are cut to them. Raises InputError naming world and drone where one is not finite.
        """
        if not np.isfinite(setpoints).all():
            world, drone, _ = np.argwhere(~np.isfinite(setpoints))[0]
            level, pose = self.levels[world], self.poses[world, drone]
            raise InputError(
                f"level {level.name}: setpoint {setpoints[world, drone]} of drone {drone} in world {world}, "
                f"at ({pose[0]:.2f}, {pose[1]:.2f}), is not finite"
            )
        count = self.worlds * self.drones
        yaw = self.poses[..., 2].reshape(-1)
        velocity = self.velocity.reshape(-1, 3)
        forces = np.zeros((count + 1, 2))  # the space lists its static body after the drones
        limits = self.limits
        dt = TICK_S / _SUBSTEPS
        for _ in range(_SUBSTEPS):
            # Forces, not velocities: the solver then stops what pushes into a wall before positions move.
            _control(
                forces, velocity, yaw, setpoints.reshape(-1, 3), dt,
                limits.lag_s, limits.acceleration_mps2, limits.speed_mps, limits.yaw_rate_rps,
            )  # fmt: skip
            self._forces.set_float_buf(forces)
            pymunk.batch.set_space_bodies(self._space, pymunk.batch.BodyFields.FORCE, self._forces)
            self._space.step(dt)
            self._motion.clear()
            pymunk.batch.get_space_bodies(self._space, _MOTION_FIELDS, self._motion)
            state = np.frombuffer(self._motion.float_buf(), np.float64).reshape(-1, 4)[:count]
            velocity[:, :2] = state[:, 2:]
            self._count_contacts()
        offsets = np.repeat(self._offsets, self.drones, axis=0)
        self.poses[..., :2] = (state[:, :2] - offsets).reshape(self.worlds, self.drones, 2)
        self.poses[..., 2] = np.remainder(yaw + np.pi, 2.0 * np.pi).reshape(self.worlds, self.drones) - np.pi
        self.velocity[...] = velocity.reshape(self.velocity.shape)
        self.ticks += 1

    def _count_contacts(self) -> None:
        self._arbiters.clear()
        pymunk.batch.get_space_arbiters(self._space, _ARBITER_FIELDS, self._arbiters)
        entries = np.frombuffer(bytes(self._arbiters.int_buf()), np.uint64).reshape(-1, 3)
        for a, b, first in entries:
            if first:
                for body in (int(a), int(b)):
                    index = self._index_of.get(body)
                    if index is not None:
                        self.contacts[index // self.drones, index % self.drones] += 1

    def scan(self) -> NDArray[np.float32]:
        """Return a turn of every drone's LiDAR, float32 `[worlds, drones, beams]`: walls, posts and other drones.

        Ranges in metres with the sensor's noise; inf no return, nan below the least range.
        """
        return self._sensing.scan(self.poses, self.velocity, self.limits.radius_m, self.ticks)


@numba.njit(cache=True, nogil=True)
def _control(forces, velocity, yaw, wanted, dt, lag, acceleration, speed, fastest_yaw):  # type: ignore[no-untyped-def]
    """Write the forces (N, `[n, 2]`) that move velocities toward body setpoints `[n, 3]`, and turn the headings."""
    blend = 1.0 - np.exp(-dt / lag) if lag > 0.0 else 1.0
    for k in range(len(velocity)):
        forward, left = wanted[k, 0], wanted[k, 1]
        size = np.sqrt(forward * forward + left * left)
        if size > speed:
            forward, left = forward * speed / size, left * speed / size
        c, s = np.cos(yaw[k]), np.sin(yaw[k])
        ax = (c * forward - s * left - velocity[k, 0]) * blend / dt
        ay = (s * forward + c * left - velocity[k, 1]) * blend / dt
        size = np.sqrt(ax * ax + ay * ay)
        if size > acceleration:
            ax, ay = ax * acceleration / size, ay * acceleration / size
        forces[k, 0], forces[k, 1] = _MASS_KG * ax, _MASS_KG * ay
        rate = min(max(wanted[k, 2], -fastest_yaw), fastest_yaw)
        velocity[k, 2] += (rate - velocity[k, 2]) * blend
        yaw[k] += velocity[k, 2] * dt
