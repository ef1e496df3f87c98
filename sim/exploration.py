"""Batched exploration: the decision process that policies are trained and evaluated in.

Every tick each drone's action becomes a setpoint, passes the safety shield that also flies, moves the twin, and the
new scans become evidence, maps over the radio, observations and reward.
"""

from __future__ import annotations

import logging
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
from imagine.sim.episodes import FORMAT, Episodes, Start, check_same
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.exploration_tick import FLYING, LAUNCHING, STAGES, WAITING, Specs, fly, locate, observe, scan, share
from imagine.sim.keyed_noise import root_keys
from imagine.sim.level_variants import level_shares
from imagine.sim.metrics import EpisodeMetrics, EpisodeTotals, Recorder
from imagine.sim.odometry_drift import OdometryDrift
from imagine.sim.planner_actions import plan_worlds
from imagine.sim.randomisation import draw
from imagine.sim.reward import rewards, survivors, sweep_cells
from imagine.sim.team_maps import Scratch, TeamMaps, derive
from imagine.sim.twin import TICK_S, Twin

__all__ = ["CRITIC_CELLS", "CRITIC_CHANNELS", "EpisodeMetrics", "Exploration", "Observation", "Step"]

logger = logging.getLogger(__name__)

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
    """What a decision brings: the next observation, reward `[worlds, drones]`, which worlds ended, their metrics.

    `late` bool `[worlds]` tells which episodes ended with this decision by their time limit alone: neither was enough
    covered, nor anything left to go to, nor anybody left to go there.
    """

    observation: Observation
    reward: NDArray[np.float32]
    done: NDArray[np.bool_]
    episodes: list[EpisodeMetrics]
    late: NDArray[np.bool_]


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
        self._episodes = Episodes(settings, seed, keys)
        self.ticks = self._episodes.ticks
        rows, columns = self._episodes.variants.rows, self._episodes.variants.columns
        first = self._episodes.first_levels()
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

    @property
    def as_designed(self) -> NDArray[np.bool_]:
        """Which worlds began at the launch point of their level as it is, bool `[worlds]`."""
        return self._episodes.as_designed()

    @property
    def level_weights(self) -> NDArray[np.float64]:
        """The share of coming episodes of each level that `settings.levels` stand for, `[levels]`."""
        return self._episodes.weights.copy()

    def set_level_weights(self, weights: Sequence[float]) -> None:
        """Draw the levels of all episodes that begin from now on by other weights, one for each level.

        Ranges in `settings.levels` stand for many levels, see `sim/level_names.py`; they have a weight each here.
        Episodes in progress go on where they are. Raises InputError where a weight is negative or missing, or all are
        zero.
        """
        self._episodes.weights = level_shares(weights, len(self._episodes.variants))

    def reset(self) -> Observation:
        """Start a new episode in every world."""
        self._now = 1 - self._now
        for world in range(self.worlds):
            self._restart(world)
        if self.settings.stagger:
            self._episodes.stagger()
        self._run(np.full(self.worlds, LAUNCHING), np.full(self.worlds, LAUNCHING))
        return self.observation()

    def observation(self) -> Observation:
        """Return what the newest `reset`, `step` or `load_state_dict` showed."""
        return Observation(self._observed[self._now], self)

    def _restart(self, world: int) -> None:
        self._begin(world, self._episodes.draw(world, int(self.twin.episodes[world])))

    def _begin(self, world: int, start: Start) -> None:
        level, generator = self._episodes.begin(world, start), self._episodes.generators[world]
        self.twin.episodes[world] = start.shown
        launch = level.launch_poses(self.drones, generator if start.anywhere else None)
        self.twin.set_level(world, level, launch)
        column0, row0, _, _ = level.grid
        self.maps.clear(world, level.coverable, (column0, row0))
        self._critic.clear(world)
        self.air.clear(world, self.settings.radio.drawn(generator), draw(self.settings.budget_bytes_per_s, generator))
        self.decisions.clear(world)
        if self._drift is not None:
            self._drift.reset(world, generator)
        self._recorder.begin(world, self.twin.poses[world])

    def step(self, actions: ArrayLike) -> Step:
        """Fly one decision (`ActionSpec.decision_ticks` ticks) with actions `[worlds, drones, action size]` in [-1, 1].

        Raises InputError where they are not such numbers, naming level, drone and place where one is not finite.
        """
        wanted = action_values(actions, "actions")
        self._check(wanted)
        self._episodes.actions.add(~self._episodes.ended, wanted)
        self.decisions.decide(wanted, self.estimates)
        self._now = 1 - self._now
        reward = np.zeros((self.worlds, self.drones), np.float32)
        running, late = ~self._episodes.ended, np.zeros(self.worlds, np.bool_)
        ticks = self.settings.action.decision_ticks
        for tick in range(ticks):  # a world that ends waits for the others' decisions to end
            reward += self._tick(running, late, tick == ticks - 1)
        done = ~running
        episodes = [self._metrics(int(world)) for world in np.flatnonzero(done & ~self._episodes.ended)]
        self._episodes.ended |= done
        if self._restarts and done.any():
            for world in np.flatnonzero(done):
                self._restart(int(world))
            launching = np.where(done, LAUNCHING, WAITING)
            self._run(launching, launching)  # what they see at their launch is nobody's gain
        return Step(self.observation(), reward, done, episodes, late)

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

    def _tick(self, running: NDArray[np.bool_], late: NDArray[np.bool_], observes: bool) -> NDArray[np.float32]:
        """Fly one tick in the `running` worlds and return what was earned; clear the flag of those that end with it.

        Of these, `late` is set where only the time limit ended them.
        """
        flying = self.alive & running[:, None]
        shown = np.full(self.worlds, FLYING if observes else WAITING)  # also those that ended before the others
        begun, coverage = self._advance(running, shown)
        gained = np.where(running[:, None], self.maps.arrays.gained, 0)
        completed = running & (coverage >= self.settings.stop_coverage)
        earned = rewards(gained, begun, flying, self.maps.coverable_cells, self.settings.reward, self._swept, completed)
        idle, sees = self._episodes.idle, self.maps.arrays.frontiers.any(axis=1)
        idle[...] = np.where(running, np.where(sees, 0, idle + 1), idle)
        over = completed | (idle >= _IDLE_TICKS) | ~self.alive.any(axis=1)
        timed_out = self.ticks >= self._episodes.limit
        late |= running & timed_out & ~over
        running &= ~(over | timed_out)
        return earned

    def _advance(
        self, running: NDArray[np.bool_], shown: NDArray[np.int64], derives: bool = True
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Fly one tick in the `running` worlds; return the contacts begun `[worlds, drones]` and the coverage."""
        touched = self.twin.contacts.copy()
        self.ticks += running
        self._run(np.where(running, FLYING, WAITING), shown, derives)
        begun = self.twin.contacts - touched
        coverage = self.maps.coverage()
        self.alive[...] = np.where(running[:, None], survivors(self.alive, begun, self.settings.reward), self.alive)
        self._recorder.record(coverage, self.twin.poses, self.links(), self.maps.discovered, self.alive, running)
        return begun, coverage

    def _run(self, modes: NDArray[np.int64], shown: NDArray[np.int64], derives: bool = True) -> None:
        """Run a tick in all worlds, as `modes` says for each; observe those whose mode in `shown` is not WAITING.

        Without `derives` beliefs and frontier fields stay as they are until a tick that does.
        """
        observes = bool((shown != WAITING).any())
        twin = self.twin
        sensors, flight = twin.sensors(self._sight_m), twin.kernel_args()
        levels = sensors.levels, sensors.rows
        seen = self._observed[self._now]
        maps, air, turns = self.maps.arrays, self.air.state, self._episodes.turns
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
                first, last, modes, turns, self.ranges, sensors, twin.poses, twin.velocity, twin.alive,
                twin.mover_discs, twin.mover_edges, twin.limits.radius_m,
            )  # fmt: skip
            lap("scan")
            share(
                first, last, modes, self.ticks, self._keys, twin.poses, twin.velocity, self.estimates, twin.alive,
                self.ranges, maps, self.maps.pens, air, levels, scratch,
            )  # fmt: skip
            lap("share")
            if derives:
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
            if self.settings.observation.frontiers:
                self.decisions.fill_frontiers(
                    seen["frontiers"], maps.kinds, maps.states, maps.belief, self.estimates, self.maps.origins,
                    shown != WAITING,
                )  # fmt: skip

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
        """Return what an equal environment goes on from exactly: plain containers and arrays of the caller's own.

        It tells how the episodes in progress began, and all actions since: 4 bytes for each number, so that 64 worlds
        of 3 drones are 1.5 MB at most after 1000 decisions of 2 numbers. Of what was changed from outside, as by
        setting `alive`, it knows nothing.
        """
        return {
            "format": FORMAT,
            "of": self._identity(),
            "episodes": self._episodes.state_dict(),
            "shown": self.twin.episodes.copy(),
            "twin_ticks": self.twin.ticks,
            "poses": self.twin.poses.copy(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> Observation:
        """Go on from where the environment stood that gave `state`; return what it had shown last.

        The episodes in progress are flown again up to there, without policy, frontier fields and observations; from
        then on all is equal to the last bit. Where this machine or version computes differently a world may come out
        elsewhere: it starts a new episode, and a warning says so. Of a state from before the first `reset`, `reset`
        starts the same episodes. Raises InputError where the state is of an environment with other settings, levels,
        seed or keys, naming what differs.
        """
        check_same(state, self._identity())
        starts = self._episodes.starts(state["episodes"])
        for world, start in enumerate(starts):
            self._begin(world, start)
        nobody, everybody = np.full(self.worlds, WAITING), np.full(self.worlds, FLYING)
        if starts:
            self._run(np.full(self.worlds, LAUNCHING), nobody, derives=False)
            self._fly_again(state["episodes"], nobody)
        self._episodes.load_state_dict(state["episodes"])
        self.twin.episodes[...] = state["shown"]
        if starts:
            self._run(self._begin_lost(state["poses"]), everybody)
        self.twin.ticks = int(state["twin_ticks"])
        return self.observation()

    def _identity(self) -> dict[str, Any]:
        """Return all that decides how worlds go on from a state."""
        settings = self.settings.model_dump(mode="json")
        del settings["level_weights"]  # those that count now are part of the state
        return {
            "seed": self.seed,
            "world_keys": list(self.twin.world_keys),
            "restart": self._restarts,
            **settings,
            "fingerprints": self._episodes.variants.fingerprints,
        }

    def _fly_again(self, state: dict[str, Any], nobody: NDArray[np.int64]) -> None:
        """Fly the episodes that have begun again, each as far as it had come."""
        self._episodes.actions.load_state_dict(state)
        for actions in self._episodes.actions.decisions():
            self.decisions.decide(actions, self.estimates)
            for _ in range(self.settings.action.decision_ticks):
                self._advance(self.ticks < state["ticks"], nobody, derives=False)  # beliefs follow from the last maps

    def _begin_lost(self, poses: NDArray[np.float64]) -> NDArray[np.int64]:
        """Begin new episodes where drones did not come to `poses` `[worlds, drones, 3]`; return all worlds' modes."""
        lost = (self.twin.poses != poses).any(axis=(1, 2))
        if lost.any():
            logger.warning(
                "worlds %s did not come out as they were saved, since this machine or version computes differently: "
                "they start new episodes", ", ".join(map(str, np.flatnonzero(lost).tolist())),
            )  # fmt: skip
        for world in np.flatnonzero(lost).tolist():
            self._restart(world)
        return np.where(lost, LAUNCHING, WAITING)


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
