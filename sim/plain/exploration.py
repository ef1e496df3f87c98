"""The step of exploration for one world, made the straightforward way."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from imagine.core.action import to_body_velocity
from imagine.core.frames import Pose
from imagine.core.frontier import FrontierField
from imagine.core.lidar import Scan
from imagine.core.planner import plan_velocity
from imagine.core.raster import TILE
from imagine.core.shield import shield_velocity
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.level import Level, load_level, mirrored
from imagine.sim.plain.field import heap_ways, scipy_ways
from imagine.sim.plain.kernel_maps import KernelMaps
from imagine.sim.plain.maps import PlainMaps, WorldMaps
from imagine.sim.plain.steering import body_velocity, shielded
from imagine.sim.plain.views import critic_images
from imagine.sim.plain.world import PlainWorld

Variant = Literal["plain", "plain-scipy", "plain-kernels"]
_IDLE_TICKS = 30  # an episode ends when nobody has had a frontier for so long
STAGES = ("setpoints", "physics", "rays", "integration", "exchange", "belief", "field", "views", "rest")


@dataclass(frozen=True)
class PlainStep:
    """What a tick brings: the next observation and critic images `[drones, ...]`, reward `[drones]`, whether it ended.

    `coverage` is the share seen before a new episode begins.
    """

    policy: dict[str, NDArray[np.float32]]
    critic: NDArray[np.float32]
    reward: NDArray[np.float32]
    done: bool
    coverage: float


class PlainExploration:
    """One world being explored; a finished one starts anew by itself."""

    def __init__(
        self,
        settings: ExplorationSettings,
        seed: int,
        world: int = 0,
        variant: Variant = "plain",
        clock: Callable[[], float] | None = None,
    ) -> None:
        """Prepare what world `world` of `Exploration(settings, seed)` explores: the same levels from the same launches.

        "plain" plans with a heap in Python, "plain-scipy" with scipy's Dijkstra. "plain-kernels" takes the project's
        compiled functions of one drone for shield, maps and observations; rays, physics and the loop over drones stay
        plain. A `clock` (seconds) fills `stage_seconds`, by stage.
        """
        self.settings, self.variant = settings, variant
        self.lidar = settings.lidar_spec
        self.drones = settings.drones
        self._levels = [_variants(load_level(name), settings.mirror) for name in settings.levels]
        weights = np.array(settings.level_weights or (1.0,) * len(self._levels), float)
        self._weights = weights / weights.sum()
        self._generator = np.random.default_rng([seed, world])
        self._noise = np.random.default_rng([seed, world, 1])
        self._clock = clock or (lambda: 0.0)
        self._lap = self._clock()
        self.stage_seconds = dict.fromkeys(STAGES, 0.0)
        self._draw_level()  # the batch draws one to be built with, too

    def _draw_level(self) -> Level:
        variants = self._levels[self._generator.choice(len(self._levels), p=self._weights)]
        return variants[self._generator.integers(len(variants))]

    def reset(self) -> None:
        """Start a new episode, up to the first look around."""
        level = self._draw_level()
        generator = self._generator if self.settings.random_launch else None
        self.begin(level, level.launch_poses(self.drones, generator))
        self._took("rest")
        scan = self.world.scan(self._noise)
        self._took("rays")
        self.sense(scan)

    def begin(self, level: Level, poses: list[Pose]) -> None:
        """Put the drones into a level of which nothing is known."""
        self.world = PlainWorld(level, poses, self.lidar, self.settings.limits)
        range_cap_m = self.settings.map.range_cap_m
        self.maps: WorldMaps
        if self.variant == "plain-kernels":
            self.maps = KernelMaps(level, self.drones, self.lidar, range_cap_m)
        else:
            ways = heap_ways if self.variant == "plain" else scipy_ways
            self.maps = PlainMaps(level, self.drones, self.lidar, range_cap_m, ways)
        self.ranges = np.full((self.drones, self.lidar.beams), np.nan, np.float32)
        self.ticks = self._idle = 0
        self._limit = self.settings.episode_ticks

    def take_over(self, batch: Exploration, world: int) -> None:
        """Go on from the state that a world of a batch is in now."""
        twin, maps = batch.twin, batch.maps
        level = twin.levels[world]
        self.begin(level, [Pose(*pose) for pose in twin.poses[world].tolist()])
        self.world.set_velocity(twin.velocity[world])
        _, _, columns, rows = level.grid
        tiles = rows // TILE, columns // TILE
        self.maps.take_over(
            maps.layers[world, ..., :rows, :columns],
            maps.versions[world, ..., : tiles[0], : tiles[1]],
            maps.clocks[world],
        )
        self.maps.seen[...] = maps.seen[world, :rows, :columns]
        self.maps.discovered[...] = maps.discovered[world]
        self.maps.tiles_sent[...] = maps.tiles_sent[world]
        self.ranges[...] = batch._ranges[world]
        self.ticks, self._idle, self._limit = int(batch.ticks[world]), int(batch._idle[world]), int(batch._limit[world])
        self.maps.derive()
        self.maps.plan()

    def step(self, actions: NDArray[np.float32]) -> PlainStep:
        """Fly one tick with actions `[drones, action size]` in [-1, 1]."""
        self._lap = self._clock()
        before = self.maps.discovered.copy()
        self.fly(actions)
        scan = self.world.scan(self._noise)
        self._took("rays")
        self.sense(scan)
        return self.finish(before)

    def fly(self, actions: NDArray[np.float32]) -> None:
        """Move the drones through one tick."""
        setpoints = self.setpoints(actions)
        self._took("setpoints")
        self.world.step(setpoints)
        self.ticks += 1
        self._took("physics")

    def setpoints(self, actions: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the shielded body-frame velocity setpoints `[drones, 3]` of actions."""
        spec, limits, axes = self.settings.action, self.settings.limits, self.settings.observation.axes
        setpoints = np.zeros((self.drones, 3))
        for drone, (action, yaw) in enumerate(zip(actions, self.world.poses[:, 2].tolist(), strict=True)):
            if self.variant == "plain-kernels":
                vx, vy, rate = to_body_velocity(action, spec, axes, yaw)
                vx, vy = shield_velocity(vx, vy, Scan(0.0, self.ranges[drone]), self.lidar, limits)
            else:
                vx, vy, rate = body_velocity(action, spec, axes == "map", yaw)
                vx, vy = shielded(vx, vy, self.ranges[drone], self.lidar, limits)
            setpoints[drone] = vx, vy, rate
        return setpoints

    def sense(self, ranges: NDArray[np.float32]) -> None:
        """Map everyone's scan `[drones, beams]`, and share maps over the radio."""
        self.ranges = ranges
        connected = self.links()
        self.maps.integrate(ranges, self.world.poses, connected)
        self._took("integration")
        self.maps.exchange(connected, self.settings.protocol == "multi-hop", self.settings.tiles_a_tick)
        self._took("exchange")
        self.maps.derive()
        self._took("belief")
        self.maps.plan()
        self._took("field")

    def links(self) -> NDArray[np.bool_]:
        """Tell which drones hear which now, bool `[drones, drones]`: a disc, the diagonal left out."""
        if self.settings.protocol == "off":
            return np.zeros((self.drones, self.drones), np.bool_)
        positions = self.world.poses[:, :2]
        apart = np.linalg.norm(positions[:, None] - positions, axis=-1)
        linked: NDArray[np.bool_] = (apart <= self.settings.radio_range_m) & ~np.eye(self.drones, dtype=np.bool_)
        return linked

    def finish(self, discovered_before: NDArray[np.int64]) -> PlainStep:
        """Reward what was discovered, end and restart the episode where it is over, and observe."""
        settings = self.settings
        share = (self.maps.discovered - discovered_before) / self.maps.coverable_cells
        reward = settings.reward_scale * (settings.own_credit * share + (1.0 - settings.own_credit) * share.mean())
        busy = any(np.isfinite(distance).any() for distance in self.maps.distance)
        self._idle = 0 if busy else self._idle + 1
        coverage = self.coverage()
        done = coverage >= settings.stop_coverage or self.ticks >= self._limit or self._idle >= _IDLE_TICKS
        self._took("rest")
        if done:
            self.reset()
        return self._step(reward, done, coverage)

    def coverage(self) -> float:
        """Return the share of the coverable cells that the team has seen."""
        return float(self.maps.discovered.sum() / self.maps.coverable_cells)

    def observe(self) -> tuple[dict[str, NDArray[np.float32]], NDArray[np.float32]]:
        """Return what the policy sees, by name, and the critic's images, `[drones, ...]`."""
        poses, spec = self.world.poses, self.settings.observation
        seen = [
            self.maps.observe(drone, spec, (x, y, yaw), self.world.velocity[drone], self.ranges[drone])
            for drone, (x, y, yaw) in enumerate(poses.tolist())
        ]
        policy = {name: np.stack([one[name] for one in seen]) for name in spec.shapes}
        return policy, critic_images(self.maps.seen, self.maps.coverable, self.world.level.grid[:2], poses)

    def _step(self, reward: NDArray[np.float64], done: bool, coverage: float) -> PlainStep:
        policy, critic = self.observe()
        self._took("views")
        return PlainStep(policy, critic, reward.astype(np.float32), done, coverage)

    def _took(self, stage: str) -> None:
        now = self._clock()
        self.stage_seconds[stage] += now - self._lap
        self._lap = now

    def planner_actions(self) -> NDArray[np.float32]:
        """Return the frontier planner's action for every drone, zero where it sees no frontier to go to."""
        actions = np.zeros((self.drones, self.settings.action.size), np.float32)
        axes = self.settings.observation.axes
        for drone in range(self.drones):
            pose = Pose(*self.world.poses[drone].tolist())
            field = FrontierField(self.maps.distance[drone], self.maps.states[drone])
            scan = Scan(0.0, self.ranges[drone])
            wanted = plan_velocity(field, self.maps.origins[drone], pose, scan, self.lidar, 1.0)
            if wanted is None:
                continue
            ux, uy = wanted
            if self.settings.action.mode == "body" or axes == "heading":
                c, s = np.cos(pose.yaw), np.sin(pose.yaw)
                ux, uy = c * ux + s * uy, -s * ux + c * uy
            actions[drone] = (ux, uy, 0.0)[: self.settings.action.size]
        return actions


def _variants(level: Level, mirror: bool) -> list[Level]:
    if not mirror:
        return [level]
    return [mirrored(level, *flags) for flags in itertools.product((False, True), repeat=3)]
