"""The twin's physics and sensing: many worlds of drones, each in a pymunk space of its own, stepped together.

Each drone is a disc with a velocity controller in front of it: what a setpoint asks for is approached with a lag and
a limited acceleration, and walls, crates and other drones push back.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.frames import Pose
from imagine.core.lidar import LD19, LidarSpec
from imagine.core.vehicle_limits import VehicleLimits
from imagine.sim.chipmunk import addresses
from imagine.sim.dynamics import COLUMNS, HISTORY, TICK_S, DynamicsSettings
from imagine.sim.level import Level
from imagine.sim.level_survey import LAUNCH_CLEARANCE_M
from imagine.sim.lidar_model import LidarModel
from imagine.sim.movers import Movers
from imagine.sim.physics import DRONES, MOVERS, TALLY_COLUMNS, WALLS, fastest_mps, prepare_tally, step_worlds, touched
from imagine.sim.scan_world import Sensors
from imagine.sim.sensing import Sensing
from imagine.sim.solids import Solids, build_space, free_space
from imagine.sim.workers import Workers

__all__ = ["TICK_S", "Twin"]


class Twin:
    """Worlds of drones: poses and velocities `[worlds, drones, 3]`, in metres, radians and seconds, map frame.

    `velocity` holds (vx, vy, yaw rate). `wall_contacts`, `drone_contacts` and `mover_contacts` count, per drone, how
    often it began to touch a wall, another drone, and a person or crate; `contacts` is their sum. A drone whose
    `alive` is set to False has fallen: from the next tick on it lies where it fell, below the LiDARs' plane and out of
    everyone's way.
    """

    dt = TICK_S
    step_kernel = staticmethod(step_worlds)

    def __init__(
        self,
        levels: Sequence[Level],
        drones: int,
        lidar: LidarSpec = LD19,
        limits: VehicleLimits | None = None,
        seed: int = 0,
        dynamics: DynamicsSettings | None = None,
        world_keys: Sequence[int] | None = None,
        sensing: LidarModel | None = None,
    ) -> None:
        """Make one world for each of `levels`, its drones on the level's launch poses.

        All that is random in a world depends on `seed` and its key (default: its index) alone, so world k of a batch
        flies bit for bit as a twin of one world with `world_keys=[k]`.
        """
        if not levels or drones < 1:
            raise InputError(f"a twin needs at least one world and one drone, got {len(levels)} and {drones}")
        worlds = len(levels)
        self.world_keys = tuple(range(worlds) if world_keys is None else (int(key) for key in world_keys))
        if len(self.world_keys) != worlds or min(self.world_keys) < 0:
            raise InputError(f"world keys {self.world_keys}: give one for each of the {worlds} worlds, none negative")
        self.worlds, self.drones = worlds, drones
        self.lidar = lidar
        self.limits = limits or VehicleLimits()
        self.dynamics = dynamics or DynamicsSettings()
        _check_limits(self.limits)
        self.seed = seed
        self.ticks = 0
        self.workers = Workers()
        self.poses = np.zeros((worlds, drones, 3))
        self.velocity = np.zeros((worlds, drones, 3))
        self.contacts = np.zeros((worlds, drones), np.int64)
        self.alive = np.ones((worlds, drones), bool)
        self.episodes = np.zeros(worlds, np.int64)
        """Levels set so far in each world: with seed and key it decides what the next one draws."""
        self.levels: list[Level] = list(levels)
        self._counts = np.zeros((3, worlds, drones), np.int64)
        self.wall_contacts, self.drone_contacts = self._counts[WALLS], self._counts[DRONES]
        self.mover_contacts = self._counts[MOVERS]
        self._last_touch = np.zeros_like(self._counts)
        self._ages = np.zeros(worlds, np.int64)
        self._noise_keys = np.zeros(worlds, np.uint64)
        self._dynamics = np.zeros((worlds, drones, COLUMNS))
        self._wind = np.zeros((worlds, drones, 2))
        self._history = np.zeros((worlds, drones, HISTORY, 3))
        self._movers = Movers.none(worlds)
        self._api = addresses()
        self._bodies = np.zeros((worlds, drones), np.int64)
        self._shapes = np.zeros((worlds, drones), np.int64)
        self._present = np.ones((worlds, drones), bool)
        self._tally = np.zeros((worlds, 3, TALLY_COLUMNS), np.int64)
        self._spaces = np.zeros(worlds, np.int64)
        self._walkers = np.zeros((worlds, 0), np.int64)
        self._boxes = np.zeros((worlds, 0), np.int64)
        self._arguments: tuple[Any, ...] | None = None
        self._solids: weakref.WeakKeyDictionary[Level, Solids] = weakref.WeakKeyDictionary()
        self._owned: dict[int, tuple[int, NDArray[np.int64], NDArray[np.int64]]] = {}
        weakref.finalize(self, _free_all, self._api, self._owned).atexit = False  # the process's end frees it all
        self._sensing = Sensing(worlds, drones, lidar, seed, self.workers, self.world_keys, sensing)
        for world, level in enumerate(levels):
            self.set_level(world, level, level.launch_poses(drones))

    @property
    def mover_discs(self) -> NDArray[np.float64]:
        """The people that LiDARs see, float64 `[worlds, n, 3]` (x, y, radius), metres; radius 0 is nobody."""
        return self._movers.discs

    @property
    def mover_edges(self) -> NDArray[np.float64]:
        """The crates' edges that LiDARs see, float64 `[worlds, m, 4]` (x0, y0, x1, y1), metres; all 0 is none."""
        return self._movers.edges

    @property
    def wind(self) -> NDArray[np.float64]:
        """How the air moves at each drone, float64 `[worlds, drones, 2]`, m/s, map frame."""
        return self._wind

    @property
    def drawn_dynamics(self) -> NDArray[np.float64]:
        """This episode's dynamics of every drone, float64 `[worlds, drones, COLUMNS]` of `sim/dynamics.py`."""
        return self._dynamics

    def set_level(self, world: int, level: Level, poses: Sequence[Pose]) -> None:
        """Begin an episode in a world: drones at rest at `poses`, alive, in another (or the same) level."""
        if len(poses) != self.drones:
            raise InputError(f"level {level.name}: {len(poses)} launch poses for {self.drones} drones")
        words = [self.seed % 2**64, self.world_keys[world], int(self.episodes[world])]
        rng = np.random.default_rng(words)
        self.episodes[world] += 1
        self._dynamics[world] = self.dynamics.draw(rng, self.drones, self.limits)
        self._noise_keys[world] = rng.integers(2**64, dtype=np.uint64)
        if self._movers.make_room(level):
            self._walkers = _widened(self._walkers, self._movers.people.shape[1])
            self._boxes = _widened(self._boxes, self._movers.crates.shape[1])
            self._arguments = None
        self._movers.place(world, level, rng, poses, self.limits.radius_m)
        self.levels[world] = level
        self._sensing.set_level(world, level)
        self._sensing.randomise(world, rng)
        self.poses[world] = poses
        self.velocity[world] = 0.0
        self.contacts[world] = 0
        self.alive[world] = self._present[world] = True
        self._ages[world] = 0
        self._wind[world] = 0.0
        self._history[world] = 0.0
        self._build(world, level)

    def _build(self, world: int, level: Level) -> None:
        """Put a world's walls, drones and movers into a new space."""
        solids = self._solids.get(level)
        if solids is None:
            solids = self._solids[level] = Solids.of(level)
        if world in self._owned:
            free_space(self._api, *self._owned.pop(world))
        prepare_tally(self._api, world, self._tally, self._bodies, self._counts, self._last_touch)
        self._owned[world] = build_space(
            self._api, solids.segments, solids.vertices, solids.starts, solids.posts, self.poses[world],
            self._dynamics[world], self.limits.radius_m, self._movers.people[world], self._movers.crates[world],
            touched.address, self._tally[world], self._bodies[world], self._shapes[world], self._walkers[world],
            self._boxes[world],
        )  # fmt: skip
        self._spaces[world] = self._owned[world][0]

    def kernel_args(self) -> tuple[Any, ...]:
        """Return what `step_kernel(first, last, setpoints, *kernel_args())` takes, for kernels that fuse several steps.

        Ask anew in every tick, since a level with more people or crates than any before brings larger arrays; and count
        `ticks` up yourself.
        """
        if self._arguments is None:
            limits, movers = self.limits, self._movers
            self._arguments = (
                self._api, self._spaces, self._bodies, self._shapes, self._tally, self._counts, self._last_touch,
                self.contacts, self._ages, self._noise_keys, self.poses, self.velocity, self.alive, self._present,
                self._dynamics, self._wind, self._history, (limits.speed_mps, limits.yaw_rate_rps, limits.radius_m),
                movers.loops, movers.walks, movers.people, self._walkers, movers.crates, self._boxes, movers.discs,
                movers.edges,
            )  # fmt: skip
        return self._arguments

    def sensors(self, reach_m: float) -> Sensors:
        """Return what kernels scan by, to `reach_m` at most; good until the next level is set."""
        return self._sensing.sensors(reach_m)

    def check(self, setpoints: NDArray[np.float64]) -> None:
        """Raise InputError naming level, drone and place where a setpoint `[worlds, drones, 3]` is not finite."""
        if not np.isfinite(setpoints).all():
            world, drone, _ = np.argwhere(~np.isfinite(setpoints))[0]
            level, pose = self.levels[world], self.poses[world, drone]
            raise InputError(
                f"level {level.name}: setpoint {setpoints[world, drone]} of drone {drone} in world {world}, "
                f"at ({pose[0]:.2f}, {pose[1]:.2f}), is not finite"
            )

    def step(self, setpoints: NDArray[np.float64]) -> None:
        """Fly one tick with body-frame velocity setpoints `[worlds, drones, 3]` (forward, left, yaw rate).

        Setpoints past the limits are cut to them. Raises InputError naming world and drone where one is not finite.
        """
        self.check(setpoints)
        wanted = np.ascontiguousarray(setpoints, np.float64)
        self.workers.over(self.worlds, step_worlds, wanted, *self.kernel_args())
        self.ticks += 1

    def scan(self) -> NDArray[np.float32]:
        """Return a turn of every drone's LiDAR, float32 `[worlds, drones, beams]`: all that stands or moves about it.

        Ranges in metres with the sensor's noise; inf no return, nan below the least range. Fallen drones are not seen,
        and their own rows are nan.
        """
        return self._sensing.scan(
            self.poses, self.velocity, self.limits.radius_m, self.ticks, self.mover_discs, self.mover_edges,
            alive=self.alive,
        )  # fmt: skip


def _check_limits(limits: VehicleLimits) -> None:
    """Refuse what the twin cannot keep out of walls, or cannot launch."""
    fastest = fastest_mps(limits.radius_m)
    if limits.speed_mps > fastest:
        raise InputError(
            f"limits: speed_mps is {limits.speed_mps:g}, but the twin holds a drone of radius {limits.radius_m:g} m "
            f"out of walls up to {fastest:.2g} m/s only: lower the speed"
        )
    if limits.radius_m > LAUNCH_CLEARANCE_M:
        raise InputError(
            f"limits: radius_m is {limits.radius_m:g}, but levels launch drones {LAUNCH_CLEARANCE_M:g} m off walls: "
            "give a smaller radius"
        )


def _widened(array: NDArray[np.int64], columns: int) -> NDArray[np.int64]:
    grown = np.zeros((len(array), columns), np.int64)
    grown[:, : array.shape[1]] = array
    return grown


def _free_all(api: NDArray[np.int64], owned: dict[int, tuple[int, NDArray[np.int64], NDArray[np.int64]]]) -> None:
    for space, shapes, bodies in owned.values():
        free_space(api, space, shapes, bodies)
    owned.clear()
