"""Batched exploration: the decision process that policies are trained and evaluated in.

Every tick each drone's action becomes a setpoint, passes the safety shield that also flies, moves the twin, and the
new scans become evidence, maps over the radio, observations and reward.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imagine.core.errors import InputError
from imagine.core.lidar import TEAMMATE_RADIUS_M
from imagine.core.raster import TILE
from imagine.sim.action_values import action_values
from imagine.sim.air import Air
from imagine.sim.air_receive import claim_own
from imagine.sim.critic_images import CRITIC_CELLS, CRITIC_CHANNELS, CriticImages
from imagine.sim.decision_state import DecisionState
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.exploration_tick import FLYING, LAUNCHING, STAGES, WAITING, Specs, fly, locate, observe, scan, share
from imagine.sim.keyed_noise import root_keys
from imagine.sim.level import Level
from imagine.sim.level_names import expand_levels
from imagine.sim.level_variants import LevelVariants, level_shares
from imagine.sim.metrics import EpisodeMetrics, EpisodeTotals, Recorder
from imagine.sim.odometry_drift import OdometryDrift
from imagine.sim.planner_actions import plan_worlds
from imagine.sim.randomisation import draw
from imagine.sim.reward import rewards, survivors, sweep_cells
from imagine.sim.team_maps import Scratch, TeamMaps, derive
from imagine.sim.twin import TICK_S, Twin

__all__ = ["CRITIC_CELLS", "CRITIC_CHANNELS", "EpisodeMetrics", "Exploration", "Observation", "Step"]

_IDLE_TICKS = 30  # an episode ends when nobody has had a frontier for so long
_AIR_KEY = 0x41495221  # so that radio losses and sensor noise of a seed are not drawn from the same keys


@dataclass(frozen=True)
class Observation:
    """What policies see (`[worlds, drones, ...]`, named as ObservationSpec.shapes), and on demand what a critic sees.

    The arrays are the batch's own and good until the step after the next: copy what you keep longer.
    """

    policy: dict[str, NDArray[np.float32]]
    _exploration: Exploration

    @property
    def critic(self) -> NDArray[np.float32]:
        """Images of the whole level for a centralised critic, `[worlds, drones, channels, n, n]`, as it is now."""
        return self._exploration.critic_images()


@dataclass(frozen=True)
class Step:
    """What a decision brings: the next observation, reward `[worlds, drones]`, which worlds ended, their metrics."""

    observation: Observation
    reward: NDArray[np.float32]
    done: NDArray[np.bool_]
    episodes: list[EpisodeMetrics]


class Exploration:
    """A batch of worlds being explored; finished worlds start anew by themselves.

    `alive` bool `[worlds, drones]`; `ticks` `[worlds]` of the episodes in progress; `estimates` `[worlds, drones, 3]`
    what drones take their poses to be: the true ones, unless `settings.drift` is on. Then they fly, map, tell peers and
    see by their estimates, and what the team has seen is where their maps put it; physics, rays and radio know better.
    """

    dt = TICK_S

    def __init__(
        self,
        settings: ExplorationSettings,
        seed: int,
        restart: bool = True,
        world_keys: Sequence[int] | None = None,
    ) -> None:
        """Load the levels. Equal settings and seed give equal runs, and `reset` starts the first episodes.

        Without `restart` a finished world stays as it ended until `reset`, done in every step. All that is random in a
        world depends on `seed` and its key (default: its index) alone: world k of a batch equals a batch of one with
        `world_keys=[k]`. Raises InputError where a level is wrong, and on a negative seed or key.
        """
        self.settings = settings
        self._restarts = restart
        worlds, drones = settings.worlds, settings.drones
        self.worlds, self.drones, self.seed = worlds, drones, seed
        self.lidar = settings.lidar_spec
        keys = list(range(worlds)) if world_keys is None else list(world_keys)
        _check_seeds(seed, keys, worlds)
        names, shares = expand_levels(settings.levels, settings.level_weights)
        self._variants = LevelVariants(names, settings.mirror)
        self._weights = np.array(shares)
        self._generators = [np.random.default_rng([seed, key]) for key in keys]
        rows, columns = self._variants.rows, self._variants.columns
        first = [self._draw_level(world) for world in range(worlds)]
        self.twin = Twin(first, drones, self.lidar, settings.limits, seed, settings.dynamics, keys, settings.sensing)
        workers = self.twin.workers
        cap = settings.map.range_cap_m
        self.maps = TeamMaps(worlds, drones, rows, columns, self.lidar, cap, workers)
        self.air = Air(
            worlds, drones, rows // TILE, columns // TILE, settings.radio, settings.mesh, self.lidar, cap, TICK_S
        )
        self.decisions = DecisionState(worlds, drones, rows, columns, settings.observation, settings.action, workers)
        self._critic = CriticImages(self.maps.arrays, workers)
        self._recorder = Recorder(worlds, drones, seed)
        self.ticks = np.zeros(worlds, np.int64)
        self._ended = np.zeros(worlds, bool)  # and not started anew
        self._idle = np.zeros(worlds, np.int64)
        self._limit = np.full(worlds, settings.episode_ticks)
        self._swept = sweep_cells(cap, settings.action.speed_mps, TICK_S)
        self.ranges = np.full((worlds, drones, self.lidar.beams), np.inf, np.float32)
        """The newest turn of every drone's LiDAR, `[worlds, drones, beams]`: metres, inf no return, nan invalid."""
        self._drift = OdometryDrift(worlds, drones, settings.drift, TICK_S, workers) if settings.drift.enabled else None
        self.estimates = self.twin.poses if self._drift is None else self.twin.poses.copy()
        self._specs = _specs(settings, self.decisions)
        self.stage_seconds: dict[str, float] = {}
        self._timing = threading.Lock()
        self._sight_m = max(cap + 2.0 * TEAMMATE_RADIUS_M, settings.observation.lidar_range_m)
        self._keys = root_keys(seed ^ _AIR_KEY, np.array(keys))
        self._turns = np.zeros(worlds, np.int64)
        self._setpoints = np.zeros((worlds, drones, 3))
        self._observed = self._observation_arrays(), self._observation_arrays()
        self._now = 0

    def _observation_arrays(self) -> dict[str, NDArray[np.float32]]:
        size = (self.worlds, self.drones)
        return {name: np.zeros((*size, *shape), np.float32) for name, shape in self.settings.observation.shapes.items()}

    @property
    def alive(self) -> NDArray[np.bool_]:
        """Who still flies, bool `[worlds, drones]`."""
        return self.twin.alive

    def _draw_level(self, world: int) -> Level:
        return self._variants.get(*self._variants.draw(self._generators[world], self._weights))

    @property
    def level_weights(self) -> NDArray[np.float64]:
        """The share of coming episodes of each level that `settings.levels` stand for, `[levels]`."""
        return self._weights.copy()

    def set_level_weights(self, weights: Sequence[float]) -> None:
        """Draw the levels of all episodes that begin from now on by other weights, one for each level.

        Ranges in `settings.levels` stand for many levels, see `sim/level_names.py`; they have a weight each here.
        Episodes in progress go on where they are. Raises InputError where a weight is negative or missing, or all are
        zero.
        """
        self._weights = level_shares(weights, len(self._variants))

    def reset(self) -> Observation:
        """Start a new episode in every world."""
        self._now = 1 - self._now
        for world in range(self.worlds):
            self._restart(world)
            if self.settings.stagger:
                share = (world + 1) / self.worlds
                self._limit[world] = max(50, round(self.settings.episode_ticks * share))
        self._run(np.full(self.worlds, LAUNCHING), np.full(self.worlds, LAUNCHING))
        return self._observation()

    def _restart(self, world: int) -> None:
        level = self._draw_level(world)
        generator = self._generators[world] if self.settings.random_launch else None
        self.twin.set_level(world, level, level.launch_poses(self.drones, generator))
        column0, row0, _, _ = level.grid
        self.maps.clear(world, level.coverable, (column0, row0))
        self._critic.clear(world)
        draws = self._generators[world]
        self.air.clear(world, self.settings.radio.drawn(draws), draw(self.settings.budget_bytes_per_s, draws))
        self.decisions.clear(world)
        self.ticks[world] = 0
        self._ended[world] = False
        self._idle[world] = 0
        self._limit[world] = self.settings.episode_ticks
        if self._drift is not None:
            self._drift.reset(world, self._generators[world])
        self._recorder.begin(world, self.twin.poses[world])

    def step(self, actions: ArrayLike) -> Step:
        """Fly one decision (`ActionSpec.decision_ticks` ticks) with actions `[worlds, drones, action size]` in [-1, 1].

        Raises InputError where they are not such numbers, naming level, drone and place where one is not finite.
        """
        wanted = action_values(actions, "actions")
        self._check(wanted)
        self.decisions.decide(wanted, self.estimates)
        self._now = 1 - self._now
        reward = np.zeros((self.worlds, self.drones), np.float32)
        running = ~self._ended
        ticks = self.settings.action.decision_ticks
        for tick in range(ticks):  # a world that ends waits for the others' decisions to end
            reward += self._tick(running, tick == ticks - 1)
        done = ~running
        episodes = [self._metrics(int(world)) for world in np.flatnonzero(done & ~self._ended)]
        self._ended |= done
        if self._restarts and done.any():
            for world in np.flatnonzero(done):
                self._restart(int(world))
            launching = np.where(done, LAUNCHING, WAITING)
            self._run(launching, launching)  # what they see at their launch is nobody's gain
        return Step(self._observation(), reward, done, episodes)

    def _check(self, actions: NDArray[np.float32]) -> None:
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

    def _tick(self, running: NDArray[np.bool_], observes: bool) -> NDArray[np.float32]:
        """Fly one tick in the `running` worlds, clear the flag of those that end with it, return what was earned."""
        touched = self.twin.contacts.copy()
        flying = self.alive & running[:, None]
        self.ticks += running
        shown = np.full(self.worlds, FLYING if observes else WAITING)  # also those that ended before the others
        self._run(np.where(running, FLYING, WAITING), shown)
        gained = np.where(running[:, None], self.maps.arrays.gained, 0)
        begun = self.twin.contacts - touched
        coverage = self.maps.coverage()
        completed = running & (coverage >= self.settings.stop_coverage)
        earned = rewards(gained, begun, flying, self.maps.coverable_cells, self.settings.reward, self._swept, completed)
        self.alive[...] = np.where(running[:, None], survivors(self.alive, begun, self.settings.reward), self.alive)
        self._recorder.record(coverage, self.twin.poses, self.links(), self.maps.discovered, self.alive, running)
        self._idle[...] = np.where(
            running, np.where(self.maps.arrays.frontiers.any(axis=1), 0, self._idle + 1), self._idle
        )
        over = completed | (self.ticks >= self._limit) | (self._idle >= _IDLE_TICKS) | ~self.alive.any(axis=1)
        running &= ~over
        return earned

    def _run(self, modes: NDArray[np.int64], shown: NDArray[np.int64]) -> None:
        """Run a tick in all worlds, as `modes` says for each; observe those whose mode in `shown` is not WAITING."""
        observes = bool((shown != WAITING).any())
        twin = self.twin
        sensors, flight = twin.sensors(self._sight_m), twin.kernel_args()
        levels = sensors.levels, sensors.rows
        seen = self._observed[self._now]
        maps, air = self.maps.arrays, self.air.state
        drift = None if self._drift is None else self._drift.kernel_args()

        def run_part(first: int, last: int, scratch: Scratch) -> None:
            lap = self._lap()
            fly(
                first, last, modes, self.decisions.intents, self._setpoints, self.ranges, self.estimates, twin.alive,
                self._specs, flight,
            )  # fmt: skip
            if drift is not None:
                locate(first, last, modes, self.estimates, twin.poses, drift)
            lap("fly")
            scan(
                first, last, modes, self._turns, self.ranges, sensors, twin.poses, twin.velocity, twin.alive,
                twin.mover_discs, twin.mover_edges, twin.limits.radius_m,
            )  # fmt: skip
            lap("scan")
            share(
                first, last, modes, self.ticks, self._keys, twin.poses, twin.velocity, self.estimates, twin.alive,
                self.ranges, maps, self.maps.pens, air, levels, scratch,
            )  # fmt: skip
            lap("share")
            derive(first, last, maps, scratch)
            lap("derive")
            if observes:
                observe(
                    first, last, shown, seen["views"], seen["lidar"], seen["motion"], maps.belief, maps.cost,
                    maps.origins, self.estimates, twin.velocity, self.ranges, self._specs,
                )  # fmt: skip
                lap("observe")

        busy = np.flatnonzero((modes != WAITING) | (shown != WAITING))
        if 8 * len(busy) <= self.worlds:  # launches of a few worlds are done before threads would have begun
            for world in busy.tolist():
                run_part(world, world + 1, self.maps.scratch[0])
        else:
            twin.workers.over(self.worlds, run_part, scratch=self.maps.scratch)
        twin.ticks += 1
        active = modes != WAITING
        self.decisions.sense(self.estimates, self.air, self.ticks, self.maps.origins, self.alive, active)
        if observes:
            self.decisions.fill(seen["views"], seen["motion"], self.estimates, self.maps.origins)

    def time_stages(self) -> None:
        """Begin to add up the processor time that each stage of a tick takes, see `stage_seconds`."""
        self.stage_seconds = dict.fromkeys(STAGES, 0.0)

    def _lap(self) -> Callable[[str], None]:
        """Return what adds this thread's processor time since it was last called to a stage."""
        if not self.stage_seconds:
            return lambda _: None
        before = time.thread_time()

        def add(stage: str) -> None:
            nonlocal before
            now = time.thread_time()
            with self._timing:
                self.stage_seconds[stage] += now - before
            before = now

        return add

    def links(self) -> NDArray[np.bool_]:
        """Tell who exchanges maps with whom now, bool `[worlds, drones, drones]`; nobody under the protocol `off`."""
        if self.settings.protocol == "off":
            return np.zeros((self.worlds, self.drones, self.drones), bool)
        linked: NDArray[np.bool_] = self.air.state.reach.astype(bool)
        linked &= self.alive[:, :, None] & self.alive[:, None]
        return linked

    def _metrics(self, world: int) -> EpisodeMetrics:
        maps, twin, own = self.maps, self.twin, range(self.drones)
        claim_own(self.air.state, world, maps.layers[world])
        totals = EpisodeTotals(
            level=twin.levels[world].name,
            coverable=int(maps.coverable_cells[world]),
            seen=int(maps.seen[world].sum()),
            discovered=maps.discovered[world],
            known=(maps.layers[world, own, own] != 0).sum(axis=(1, 2)),
            contacts=np.stack((twin.wall_contacts[world], twin.drone_contacts[world], twin.mover_contacts[world]), -1),
            bytes_by=self.air.bytes_sent[world],
            cells_by=self.air.cells_known[world],
        )
        return self._recorder.finish(world, totals)

    def _observation(self) -> Observation:
        return Observation(self._observed[self._now], self)

    def critic_images(self, out: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
        """Return what a centralised critic sees of every drone's world, float32 `[worlds, drones, channels, n, n]`.

        With `out`, contiguous and of that shape or `[worlds * drones, channels, n, n]`, they are written there.
        """
        return self._critic.fill(self.twin.poses, out)

    def planner_actions(self) -> NDArray[np.float32]:
        """Return the frontier planner's action for every drone, nan where it is dead or sees no frontier to go to."""
        actions = np.full((self.worlds, self.drones, self.settings.action.size), np.nan, np.float32)
        hold_s = (self.settings.action.decision_ticks - 1) * self.dt
        lidar = self.lidar
        self.twin.workers.over(
            self.worlds, plan_worlds, actions, self.maps.arrays, self.estimates, self.alive, self.ranges,
            (lidar.range_min, lidar.start, lidar.increment), self.decisions.parameters, hold_s,
        )  # fmt: skip
        return actions

    def state_dict(self) -> dict[str, Any]:
        """Return what decides the next episodes: the generators' states, and how many episodes each world has had."""
        return {
            "generators": [generator.bit_generator.state for generator in self._generators],
            "episodes": self.twin.episodes.tolist(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up the state of an earlier run; episodes in progress start anew."""
        for generator, saved in zip(self._generators, state["generators"], strict=True):
            generator.bit_generator.state = saved
        self.twin.episodes[...] = state["episodes"]


def _specs(settings: ExplorationSettings, decisions: DecisionState) -> Specs:
    spec, limits, lidar = settings.observation, settings.limits, settings.lidar_spec
    return Specs(
        parameters=decisions.parameters,
        shield=(limits.radius_m, limits.lag_s, limits.acceleration_mps2),
        lidar=(lidar.range_min, lidar.start, lidar.increment),
        scales_m=np.array(spec.view_scales_m),
        frontier_ranges_m=np.array(spec.frontier_ranges_m),
        lidar_range_m=spec.lidar_range_m,
        speed_mps=spec.speed_mps,
        yaw_rate_rps=spec.yaw_rate_rps,
        heading_axes=spec.axes == "heading",
    )


def _check_seeds(seed: int, keys: Sequence[int], worlds: int) -> None:
    if seed < 0:
        raise InputError(f"seed is {seed}: give 0 or more")
    if len(keys) != worlds or min(keys) < 0:
        raise InputError(f"world_keys {keys}: give one for each of the {worlds} worlds, none negative")
