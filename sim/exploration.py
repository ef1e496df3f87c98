"""Batched exploration: the decision process that policies are trained and evaluated in.

Every tick each drone's action becomes a setpoint, passes the safety shield that also flies, moves the twin, and the
new scans become evidence, maps over the radio, observations and reward.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.lidar import PRESETS
from imagine.core.planner import plan_kernel
from imagine.sim.decision_state import DecisionState
from imagine.sim.exploration_kernels import fill_critic, fill_observations, shielded_setpoints
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.level import Level, load_level, mirrored
from imagine.sim.metrics import EpisodeMetrics, EpisodeTotals, Recorder
from imagine.sim.team_maps import TeamMaps
from imagine.sim.twin import TICK_S, Twin

CRITIC_CHANNELS, CRITIC_CELLS = 5, 32
_IDLE_TICKS = 30  # an episode ends when nobody has had a frontier for so long


@dataclass(frozen=True)
class Observation:
    """What policies see (`[worlds, drones, ...]`, named as ObservationSpec.shapes) and what the critic sees."""

    policy: dict[str, NDArray[np.float32]]
    critic: NDArray[np.float32]


@dataclass(frozen=True)
class Step:
    """What a tick brings: the next observation, reward `[worlds, drones]`, which worlds ended, their metrics."""

    observation: Observation
    reward: NDArray[np.float32]
    done: NDArray[np.bool_]
    episodes: list[EpisodeMetrics]


class Exploration:
    """A batch of worlds being explored; finished worlds start anew by themselves."""

    dt = TICK_S

    def __init__(self, settings: ExplorationSettings, seed: int, restart: bool = True) -> None:
        """Load the levels and start the first episodes. Equal settings and seed give equal runs.

        Without `restart` a finished world stays as it ended until `reset`.
        """
        self.settings = settings
        self._restarts = restart
        self.worlds, self.drones = settings.worlds, settings.drones
        self.lidar = PRESETS[settings.lidar]
        self._variants = [_variants(load_level(name), settings.mirror) for name in settings.levels]
        self._weights = _weights(settings)
        self._generators = [np.random.default_rng([seed, world]) for world in range(self.worlds)]
        grids = [level.grid for variants in self._variants for level in variants]
        rows, columns = max(g[3] for g in grids), max(g[2] for g in grids)
        first = [self._draw_level(world) for world in range(self.worlds)]
        self.twin = Twin(first, self.drones, self.lidar, settings.limits, seed)
        self.maps = TeamMaps(self.worlds, self.drones, rows, columns, self.twin.workers)
        self.decisions = DecisionState(
            self.worlds, self.drones, rows, columns, settings.observation, settings.action, self.twin.workers
        )
        self.alive = np.ones((self.worlds, self.drones), bool)
        self.ticks = np.zeros(self.worlds, np.int64)
        self._idle = np.zeros(self.worlds, np.int64)
        self._limit = np.full(self.worlds, settings.episode_ticks)
        self.alive = np.ones((self.worlds, self.drones), bool)
        self._recorder = Recorder(self.worlds, self.drones, seed)
        self._ranges = np.empty((self.worlds, self.drones, self.lidar.beams), np.float32)
        self._started = False

    def _draw_level(self, world: int) -> Level:
        generator = self._generators[world]
        variants = self._variants[generator.choice(len(self._variants), p=self._weights)]
        return variants[generator.integers(len(variants))]

    def reset(self) -> Observation:
        """Start a new episode in every world."""
        for world in range(self.worlds):
            self._restart(world)
            if self.settings.stagger:
                share = (world + 1) / self.worlds
                self._limit[world] = max(50, round(self.settings.episode_ticks * share))
        self._sense(np.ones(self.worlds, bool))
        return self._observe()

    def _restart(self, world: int) -> None:
        level = self._draw_level(world)
        generator = self._generators[world] if self.settings.random_launch else None
        self.twin.set_level(world, level, level.launch_poses(self.drones, generator))
        column0, row0, _, _ = level.grid
        self.maps.clear(world, level.coverable, (column0, row0))
        self.ticks[world] = 0
        self._idle[world] = 0
        self._limit[world] = self.settings.episode_ticks
        self.alive[world] = True
        self._recorder.begin(world, self.twin.poses[world])

    def step(self, actions: NDArray[np.float32]) -> Step:
        """Fly one tick with actions `[worlds, drones, action size]` in [-1, 1]."""
        expected = (self.worlds, self.drones, self.settings.action.size)
        if actions.shape != expected:
            raise InputError(f"actions are {actions.shape}, expected {expected}")
        if not np.isfinite(actions).all():
            world, drone, _ = np.argwhere(~np.isfinite(actions))[0]
            x, y, _ = self.twin.poses[world, drone]
            raise InputError(
                f"level {self.twin.levels[world].name}: the action of drone {drone} in world {world}, "
                f"at ({x:.2f}, {y:.2f}), is not finite"
            )
        self.twin.step(self._setpoints(actions))
        self.ticks += 1
        reward = self._reward(self._sense(np.ones(self.worlds, bool)))
        done, episodes = self._finish()
        return Step(self._observe(), reward, done, episodes)

    def _setpoints(self, actions: NDArray[np.float32]) -> NDArray[np.float64]:
        setpoints = np.zeros((self.worlds, self.drones, 3))
        limits, lidar = self.settings.limits, self.lidar
        self.decisions.decide(actions, self.twin.poses)
        shielded_setpoints(
            setpoints, self.decisions.intents, self.decisions.parameters, self.twin.poses, self._ranges,
            (lidar.range_min, lidar.start, lidar.increment),
            (limits.radius_m, limits.lag_s, limits.acceleration_mps2),
        )  # fmt: skip
        return setpoints

    def _sense(self, active: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Scan, map and share in the `active` worlds; return the cells each drone was the first to see there."""
        self._ranges[active] = self.twin.scan()[active]
        lidar = self.lidar
        return self.maps.update(
            self._ranges,
            self.twin.poses,
            (lidar.start, lidar.increment, lidar.range_min, self.settings.map.range_cap_m),
            self.links(),
            self.settings.protocol == "multi-hop",
            self.settings.tiles_a_tick,
            active,
        )

    @property
    def ranges(self) -> NDArray[np.float32]:
        """The newest turn of every drone's LiDAR, `[worlds, drones, beams]`: metres, inf no return, nan invalid."""
        return self._ranges

    def links(self) -> NDArray[np.bool_]:
        """Tell which drones hear which now, bool `[worlds, drones, drones]`: a disc, the diagonal left out."""
        if self.settings.protocol == "off":
            return np.zeros((self.worlds, self.drones, self.drones), bool)
        positions = self.twin.poses[..., :2]
        apart = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1)
        linked: NDArray[np.bool_] = (apart <= self.settings.radio_range_m) & ~np.eye(self.drones, dtype=bool)
        return linked

    def _reward(self, gained: NDArray[np.int64]) -> NDArray[np.float32]:
        """Share of the level newly seen, half for the finder and half for the team (each drone's equal part)."""
        share = gained / self.maps.coverable_cells[:, None]
        own, team = self.settings.own_credit, 1.0 - self.settings.own_credit
        reward = self.settings.reward_scale * (own * share + team * share.mean(axis=1, keepdims=True))
        return np.asarray(reward, np.float32)

    def _finish(self) -> tuple[NDArray[np.bool_], list[EpisodeMetrics]]:
        coverage = self.maps.coverage()
        self._recorder.record(coverage, self.twin.poses, self.links(), self.maps.discovered, self.alive)
        done = np.zeros(self.worlds, bool)
        episodes = []
        for world in range(self.worlds):
            busy = np.isfinite(self.maps.distance[world]).any()
            self._idle[world] = 0 if busy else self._idle[world] + 1
            if (
                coverage[world] >= self.settings.stop_coverage
                or self.ticks[world] >= self._limit[world]
                or self._idle[world] >= _IDLE_TICKS
            ):
                done[world] = True
                episodes.append(self._metrics(world))
        if not self._restarts:
            return done, episodes
        for ended in np.flatnonzero(done):
            self._restart(int(ended))
        if done.any():
            self._sense(done)  # what they see at their launch is nobody's gain
        return done, episodes

    def _metrics(self, world: int) -> EpisodeMetrics:
        maps, own = self.maps, range(self.drones)
        totals = EpisodeTotals(
            level=self.twin.levels[world].name,
            coverable=int(maps.coverable_cells[world]),
            seen=int(maps.seen[world].sum()),
            discovered=maps.discovered[world],
            known=(maps.layers[world, own, own] != 0).sum(axis=(1, 2)),
            contacts=self.twin.contacts[world],
            tiles_sent=maps.tiles_sent[world],
        )
        return self._recorder.finish(world, totals)

    def _observe(self) -> Observation:
        spec, lidar = self.settings.observation, self.lidar
        batch = (self.worlds, self.drones)
        policy = {name: np.empty((*batch, *shape), np.float32) for name, shape in spec.shapes.items()}
        critic = np.zeros((*batch, CRITIC_CHANNELS, CRITIC_CELLS, CRITIC_CELLS), np.float32)
        workers = self.twin.workers
        workers.over(
            self.worlds, fill_observations, policy["views"], policy["lidar"], policy["motion"],
            self.maps.belief, self.maps.distance, self.maps.origins, self.twin.poses, self.twin.velocity, self._ranges,
            (lidar.range_min, lidar.start, lidar.increment), np.array(spec.view_scales_m),
            np.array(spec.frontier_ranges_m), spec.lidar_range_m, spec.speed_mps, spec.yaw_rate_rps,
            spec.axes == "heading",
        )  # fmt: skip
        workers.over(
            self.worlds, fill_critic, critic, self.maps.seen, self.maps.coverable, self.maps.origins, self.twin.poses
        )
        return Observation(policy, critic)

    def planner_actions(self) -> NDArray[np.float32]:
        """Return the frontier planner's action for every drone, nan where it sees no frontier to go to."""
        actions = np.full((self.worlds, self.drones, self.settings.action.size), np.nan, np.float32)
        lidar = self.lidar
        for world in range(self.worlds):
            column0, row0 = self.maps.origins[world]
            for drone in range(self.drones):
                x, y, yaw = self.twin.poses[world, drone]
                ux, uy, found = plan_kernel(
                    self.maps.distance[world, drone], self.maps.states[world, drone], column0, row0, x, y, yaw,
                    self._ranges[world, drone], lidar.range_min, lidar.start, lidar.increment,
                )  # fmt: skip
                if not found:
                    continue
                if self.settings.action.mode == "body" or self.settings.observation.axes == "heading":
                    c, s = math.cos(yaw), math.sin(yaw)
                    ux, uy = c * ux + s * uy, -s * ux + c * uy
                actions[world, drone] = (ux, uy, 0.0)[: self.settings.action.size]
        return actions

    def state_dict(self) -> dict[str, Any]:
        """Return what decides the next episodes: the generators' states."""
        return {"generators": [generator.bit_generator.state for generator in self._generators]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up the generators' states of an earlier run; episodes in progress start anew."""
        for generator, saved in zip(self._generators, state["generators"], strict=True):
            generator.bit_generator.state = saved


def _variants(level: Level, mirror: bool) -> list[Level]:
    if not mirror:
        return [level]
    flags = (False, True)
    return [mirrored(level, swap, x, y) for swap in flags for x in flags for y in flags]


def _weights(settings: ExplorationSettings) -> NDArray[np.float64]:
    given: Iterable[float] = settings.level_weights or (1.0,) * len(settings.levels)
    weights = np.array(list(given), float)
    if len(weights) != len(settings.levels) or (weights < 0).any() or weights.sum() <= 0:
        raise InputError("level_weights: give one weight for each of levels, none negative, not all zero")
    return np.asarray(weights / weights.sum())
