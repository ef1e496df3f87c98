"""The step of exploration for one world, made the straightforward way."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from imagine.core.action import action_parameters, action_toward_kernel
from imagine.core.errors import InputError
from imagine.core.frames import Pose
from imagine.core.lidar import TEAMMATE_RADIUS_M, Scan
from imagine.core.planner import plan_velocity
from imagine.sim.dynamics import TICK_S, DynamicsSettings
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.exploration_tick import STAGES as BATCH_STAGES
from imagine.sim.level import Level, load_level, mirrored
from imagine.sim.level_names import expand_levels
from imagine.sim.lidar_model import LidarModel
from imagine.sim.plain.field import heap_ways, scipy_ways
from imagine.sim.plain.handover import hand_over_maps, hand_over_mesh
from imagine.sim.plain.maps import PlainMaps
from imagine.sim.plain.means import KernelMeans, Means, NumpyMeans
from imagine.sim.plain.mesh import PlainMesh
from imagine.sim.plain.views import critic_images
from imagine.sim.plain.world import PlainWorld
from imagine.sim.reward import rewards, survivors, sweep_cells

Variant = Literal["plain", "plain-scipy", "plain-kernels"]
STAGES = (*BATCH_STAGES, "rest")
"""The batch's stages, and all that is outside of them."""
_IDLE_TICKS = 30  # an episode ends when nobody has had a frontier for so long


@dataclass(frozen=True)
class PlainStep:
    """What a decision brings: the next observation `[drones, ...]`, reward `[drones]`, whether the episode ended.

    `coverage` is the share seen before a new episode begins.
    """

    policy: dict[str, NDArray[np.float32]]
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
        compiled functions of one drone for shield, maps and observations; rays, physics, radio and the loop over
        drones stay plain. A `clock` (seconds) fills `stage_seconds`, by stage. Raises InputError for settings of what
        this lacks.
        """
        _check(settings)
        self.settings = settings
        self.lidar = settings.lidar_spec
        self.drones = settings.drones
        self._means = means(variant)
        names, shares = expand_levels(settings.levels, settings.level_weights)
        self._levels = [_variants(load_level(name), settings.mirror) for name in names]
        self._weights = np.array(shares)
        self._generator = np.random.default_rng([seed, world])
        self._noise, self._losses = np.random.default_rng([seed, world, 1]), np.random.default_rng([seed, world, 2])
        self._clock = clock or (lambda: 0.0)
        self._lap = self._clock()
        self.stage_seconds = dict.fromkeys(STAGES, 0.0)
        cap = settings.map.range_cap_m
        self._sight_m = max(cap + 2.0 * TEAMMATE_RADIUS_M, settings.observation.lidar_range_m)
        self._swept = sweep_cells(cap, settings.action.speed_mps, TICK_S)
        self._draw_level()  # the batch draws one to be built with, too

    def _draw_level(self) -> tuple[Level, Level]:
        """Draw a level; return it as it is, and the variant of it that was drawn."""
        variants = self._levels[self._generator.choice(len(self._levels), p=self._weights)]
        return variants[0], variants[self._generator.integers(len(variants))]

    def use(self, variant: Variant) -> None:
        """Go on by another variant's means."""
        self._means = means(variant)
        self.maps.use(self._means)

    def reset(self) -> None:
        """Start a new episode, up to the first look around."""
        as_it_is, level = self._draw_level()
        generator = self._generator if self.settings.random_launch else None
        if self.settings.as_designed > 0.0 and self._generator.random() < self.settings.as_designed:
            level, generator = as_it_is, None
        self.begin(level, level.launch_poses(self.drones, generator))
        self._took("rest")
        self.sense(self._scan())

    def begin(self, level: Level, poses: list[Pose]) -> None:
        """Put the drones into a level of which nothing is known."""
        settings, cap = self.settings, self.settings.map.range_cap_m
        self.world = PlainWorld(level, poses, self.lidar, settings.limits, self._sight_m)
        self.maps = PlainMaps(level, self.drones, self.lidar, cap, self._means)
        self.mesh = PlainMesh(
            self.maps.evidence, self.lidar, cap, settings.mesh, settings.radio, level.segments, self._losses
        )
        self.alive = np.ones(self.drones, np.bool_)
        self.ranges = np.full((self.drones, self.lidar.beams), np.inf, np.float32)
        self.ticks = self._idle = 0
        self._limit = settings.episode_ticks
        self._intents: list[tuple[float, ...]] = []

    def take_over(self, batch: Exploration, world: int) -> None:
        """Go on from the state that a world of a batch is in now, but for what is in flight between the radios."""
        twin = batch.twin
        self.begin(twin.levels[world], [Pose(*pose) for pose in twin.poses[world].tolist()])
        self.world.take_over(twin, world)
        hand_over_mesh(batch, world, self.maps, self.mesh)
        hand_over_maps(batch, world, self.maps)
        self.alive[...] = batch.alive[world]
        self.ranges[...] = batch.ranges[world]
        self.ticks, self._idle, self._limit = (
            int(batch.ticks[world]),
            int(batch._episodes.idle[world]),
            int(batch._episodes.limit[world]),
        )

    def step(self, actions: NDArray[np.float32]) -> PlainStep:
        """Fly one decision (`ActionSpec.decision_ticks` ticks) with actions `[drones, action size]` in [-1, 1]."""
        self._lap = self._clock()
        self.decide(actions)
        reward, done = np.zeros(self.drones, np.float32), False
        for _ in range(self.settings.action.decision_ticks):
            if not done:
                before = self.world.contacts.sum(axis=0)
                self.fly()
                self.sense(self._scan())
                earned, done = self.judge(before)
                reward += earned
        coverage = self.coverage()
        if done:
            self.reset()
        policy = self.observe()
        self._took("observe")
        return PlainStep(policy, reward, done, coverage)

    def decide(self, actions: NDArray[np.float32]) -> None:
        """Let the decisions `actions` stand until the next call."""
        spec, axes = self.settings.action, self.settings.observation.axes
        self._intents = [
            self._means.decide(action, spec, axes, Pose(*pose))
            for action, pose in zip(actions, self.world.poses.tolist(), strict=True)
        ]
        self._took("rest")

    def fly(self) -> None:
        """Move the drones through one tick of the decisions that stand."""
        self.world.keep(self.alive)
        self.world.step(self.setpoints())
        self.ticks += 1
        self._took("fly")

    def setpoints(self) -> NDArray[np.float64]:
        """Return the shielded body-frame velocity setpoints `[drones, 3]` of this tick."""
        settings = self.settings
        setpoints = np.zeros((self.drones, 3))
        for drone in np.flatnonzero(self.alive).tolist():
            setpoints[drone] = self._means.setpoint(
                self._intents[drone], settings.action, settings.observation.axes, self._pose(drone),
                self.ranges[drone], self.lidar, settings.limits,
            )  # fmt: skip
        return setpoints

    def _pose(self, drone: int) -> Pose:
        return Pose(*self.world.poses[drone].tolist())

    def _scan(self) -> NDArray[np.float32]:
        ranges = self.world.scan(self._noise)
        self._took("scan")
        return ranges

    def sense(self, ranges: NDArray[np.float32]) -> None:
        """Hear the peers, map everyone's scan `[drones, beams]`, and tell the peers; then plan."""
        self.ranges = ranges
        now = round(self.ticks * TICK_S, 9)
        self.mesh.hear(now, self.world.poses, self.alive)
        if self.ticks == 0:
            self.mesh.meet(now, self.world.poses)
        scans: list[Scan | None] = [None] * self.drones
        self.maps.gained[:] = 0
        for drone in np.flatnonzero(self.alive).tolist():
            places = self.mesh.nodes[drone].teammates(now)
            scans[drone] = self.maps.integrate(drone, self._pose(drone), Scan(now, ranges[drone]), places)
        self.mesh.speak(now, scans, self.world.poses, self.world.velocity)
        self._took("share")
        self.maps.derive()
        self._took("derive")

    def judge(self, contacts_before: NDArray[np.int64]) -> tuple[NDArray[np.float32], bool]:
        """Return what the tick earned, `[drones]`, and whether it ends the episode."""
        settings, maps = self.settings, self.maps
        begun = self.world.contacts.sum(axis=0) - contacts_before
        coverage = self.coverage()
        completed = coverage >= settings.stop_coverage
        earned = rewards(
            maps.gained[None], begun[None], self.alive[None], np.array([maps.coverable_cells]), settings.reward,
            self._swept, np.array([completed]),
        )[0]  # fmt: skip
        self.alive = survivors(self.alive[None], begun[None], settings.reward)[0]
        busy = any((field.cost == 0).any() for field in maps.fields)
        self._idle = 0 if busy else self._idle + 1
        done = completed or self.ticks >= self._limit or self._idle >= _IDLE_TICKS or not self.alive.any()
        self._took("rest")
        return earned, bool(done)

    def coverage(self) -> float:
        """Return the share of the coverable cells that the team has seen."""
        return float(self.maps.discovered.sum() / self.maps.coverable_cells)

    def observe(self) -> dict[str, NDArray[np.float32]]:
        """Return what the policy sees, by name, `[drones, ...]`."""
        spec, maps = self.settings.observation, self.maps
        seen = [
            self._means.observe(
                spec, maps.beliefs[drone], maps.fields[drone], maps.origin, self._pose(drone),
                self.world.velocity[drone], self.ranges[drone], self.lidar,
            )
            for drone in range(self.drones)
        ]  # fmt: skip
        return {name: np.stack([one[name] for one in seen]) for name in spec.shapes}

    def critic_images(self) -> NDArray[np.float32]:
        """Return what a centralised critic sees, float32 `[drones, channels, n, n]`."""
        return critic_images(self.maps.seen, self.maps.coverable, self.maps.origin, self.world.poses)

    def _took(self, stage: str) -> None:
        now = self._clock()
        self.stage_seconds[stage] += now - self._lap
        self._lap = now

    def planner_actions(self) -> NDArray[np.float32]:
        """Return the frontier planner's action for every drone, zero where it is dead or sees no frontier to go to."""
        spec = self.settings.action
        actions = np.zeros((self.drones, spec.size), np.float32)
        parameters = action_parameters(spec, self.settings.observation.axes)
        hold_s = (spec.decision_ticks - 1) * TICK_S
        for drone in np.flatnonzero(self.alive).tolist():
            pose, scan = self._pose(drone), Scan(0.0, self.ranges[drone])
            wanted = plan_velocity(self.maps.fields[drone], self.maps.origin, pose, scan, self.lidar, 1.0)
            if wanted is not None:
                actions[drone] = action_toward_kernel(*wanted, parameters, pose.yaw, hold_s)[: spec.size]
        return actions


def means(variant: Variant) -> Means:
    """Return what a variant computes with."""
    if variant == "plain-kernels":
        return KernelMeans()
    return NumpyMeans(heap_ways if variant == "plain" else scipy_ways)


def _check(settings: ExplorationSettings) -> None:
    radio = settings.radio
    lacking = {
        "dynamics": settings.dynamics != DynamicsSettings(),
        "sensing": settings.sensing != LidarModel(),
        "drift": settings.drift.enabled,
        "ranges of radio or budget": any(
            isinstance(value, tuple) for value in (radio.range_m, radio.tx_dbm, radio.loss, settings.budget_bytes_per_s)
        ),
        "observation: position, heading, peers, visits": settings.observation.version != 1,
    }
    for name, is_asked_for in lacking.items():
        if is_asked_for:
            raise InputError(f"plain exploration has no {name}: leave it at its default")


def _variants(level: Level, mirror: bool) -> list[Level]:
    if not mirror:
        return [level]
    return [mirrored(level, *flags) for flags in itertools.product((False, True), repeat=3)]
