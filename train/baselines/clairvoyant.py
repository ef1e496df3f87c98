"""A teacher that knows the level: advises, and flies, by a plan of the team's whole flight that it mends as it goes.

No drone can know what it knows. It is there to teach: a student that sees what drones see, and is told where a team
that knew everything would fly, learns levels by heart (Choudhury et al. 2018, "Data-driven planning via imitation
learning"). Flown itself, it shows how far knowing a level would get a team.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.action import action_toward_kernel
from imagine.core.frontier_choice import OFFSET_M, OFFSETS
from imagine.sim.clairvoyant import MOST_WAYPOINTS, Clairvoyant
from imagine.sim.clairvoyant_kernels import ahead, path_through
from imagine.sim.exploration import Exploration, Observation
from imagine.sim.level import Level
from imagine.sim.workers import Workers
from imagine.train.pilots import Actions

_SHARE = 0.91
"""Of the cells, planned for: what is timed, and a little more, for from the lattice more is seen than drones see."""
_EVERY_CELL = 2
_NEAR_FACTOR = 1.5
_SEARCHES, _SEARCH_TRIES, _SEARCH_HEAT = 12, 60_000, 12.0  # from a level's own launch point, once
_FIRST_TRIES, _FIRST_HEAT = 6000, 12.0  # from elsewhere, once an episode
_TRIES, _HEAT = 60, 0.3  # at every decision
_PER_METRE = 0.02  # ticks: of plans that are equally quick the shorter one is meant
_REACHED_M, _BY_M, _NEAR_BY_M = 0.45, 0.9, 2.0
_KEPT = 96  # levels, mirrors counted; some 15 MB each

_Waypoints = tuple[NDArray[np.int64], NDArray[np.int64]]


@dataclass
class _Plan:
    """A team's waypoints on a level that is known, as `clairvoyant_kernels.covered_after` takes them."""

    known: Clairvoyant
    way: NDArray[np.int64]
    lengths: NDArray[np.int64]
    generator: np.random.Generator
    tries: int = _TRIES
    heat: float = _HEAT

    @staticmethod
    def empty(known: Clairvoyant, drones: int, generator: np.random.Generator, tries: int, heat: float) -> _Plan:
        """Return the plan of a team that stays where it is."""
        way, lengths = np.zeros((drones, MOST_WAYPOINTS), np.int64), np.zeros(drones, np.int64)
        return _Plan(known, way, lengths, generator, tries, heat)

    def improve(self, starts: NDArray[np.int64], seen: NDArray[np.uint64], speed_mps: float) -> float:
        """Mend the plan from where drones are and for what is not yet seen; return the ticks that it takes."""
        needed = math.ceil(_SHARE * self.known.cells)
        return self.known.improve(
            self.way, self.lengths, starts, seen, needed, speed_mps, self.tries, self.heat, _PER_METRE, self.generator
        )


class ClairvoyantPilot:
    """Flies every drone by a team plan through the true level, toward the frontiers that it comes by."""

    name = "clairvoyant"

    def __init__(self, seed: int = 0) -> None:
        """Make a pilot that has yet to begin; `seed` is of the search for plans."""
        self._seed = seed
        self._levels: OrderedDict[int, tuple[Level, Clairvoyant]] = OrderedDict()
        self._from_launch_points: dict[tuple[int, int], tuple[Level, _Waypoints]] = {}
        self._plans: list[_Plan | None] = []

    def begin(self, env: Exploration) -> None:
        """Make room for the worlds of `env`."""
        self._plans = [None] * env.worlds

    def forget(self, worlds: NDArray[np.bool_]) -> None:
        """Drop the plans of these worlds."""
        for world in np.flatnonzero(worlds):
            self._plans[world] = None

    def act(self, env: Exploration, observation: Observation, worlds: NDArray[np.bool_] | None = None) -> Actions:
        """Return full speed along each drone's plan, nan where it is dead or has nothing left to do."""
        wanted = np.arange(env.worlds) if worlds is None else np.flatnonzero(worlds)
        for world in wanted.tolist():
            if self._plans[world] is None:
                self._plans[world] = self._plan(env, world)
        actions = np.full((env.worlds, env.drones, env.settings.action.size), np.nan, np.float32)
        directions = np.zeros((env.worlds, env.drones, 2))
        frontiers = observation.policy.get("frontiers")

        def advise(first: int, last: int) -> None:
            for world in wanted[first:last]:
                self._advise(env, world, directions[world], None if frontiers is None else frontiers[world])

        env.twin.workers.over(len(wanted), advise)
        hold_s = (env.settings.action.decision_ticks - 1) * env.dt
        _actions_toward(actions, directions, env.estimates, env.decisions.parameters, hold_s)
        return actions

    def _plan(self, env: Exploration, world: int) -> _Plan:
        level, drones, speed = env.twin.levels[world], env.drones, env.settings.action.speed_mps
        if id(level) not in self._levels:
            self._levels[id(level)] = level, Clairvoyant(level, every_cell=_EVERY_CELL, near_factor=_NEAR_FACTOR)
            if len(self._levels) > _KEPT:
                self._levels.popitem(last=False)
        self._levels.move_to_end(id(level))
        known = self._levels[id(level)][1]
        generator = np.random.default_rng([self._seed, env.twin.world_keys[world], int(env.twin.episodes[world])])
        if not env.as_designed[world]:
            plan = _Plan.empty(known, drones, generator, _FIRST_TRIES, _FIRST_HEAT)
            plan.improve(_points(known, env.twin.poses[world]), known.bits_of(env.maps.seen[world]), speed)
            return _Plan(known, plan.way, plan.lengths, generator)
        key = id(level), drones
        if key not in self._from_launch_points:  # with the level, so that its id stays its own
            self._from_launch_points[key] = level, self._search(known, level, drones, speed, env.twin.workers)
        way, lengths = self._from_launch_points[key][1]
        return _Plan(known, way.copy(), lengths.copy(), generator)

    def _search(self, known: Clairvoyant, level: Level, drones: int, speed_mps: float, workers: Workers) -> _Waypoints:
        """Return the waypoints of the best of several plans from the level's launch point."""
        starts = _points(known, np.array([pose[:2] for pose in level.launch_poses(drones)]))
        nothing = np.zeros(known.seen.shape[1], np.uint64)
        plans = [
            _Plan.empty(known, drones, np.random.default_rng([self._seed, search]), _SEARCH_TRIES, _SEARCH_HEAT)
            for search in range(_SEARCHES)
        ]
        ticks = np.zeros(_SEARCHES)

        def improve(first: int, last: int) -> None:
            for search in range(first, last):
                ticks[search] = plans[search].improve(starts, nothing, speed_mps)

        workers.over(_SEARCHES, improve)
        best = plans[int(ticks.argmin())]
        return best.way, best.lengths

    def _advise(
        self, env: Exploration, world: int, directions: NDArray[np.float64], frontiers: NDArray[np.float32] | None
    ) -> None:
        plan = self._plans[world]
        assert plan is not None
        known, poses, level = plan.known, env.twin.poses[world], env.twin.levels[world]
        starts = _points(known, poses)
        for drone in range(env.drones):
            while plan.lengths[drone] and known.far[plan.way[drone, 0], starts[drone]] < _REACHED_M:
                plan.way[drone, :-1] = plan.way[drone, 1:]
                plan.lengths[drone] -= 1
        plan.improve(starts, known.bits_of(env.maps.seen[world]), env.settings.action.speed_mps)
        column0, row0, _, _ = level.grid
        for drone in range(env.drones):
            if not (env.alive[world, drone] and plan.lengths[drone]):
                continue
            path = path_through(plan.way[drone], plan.lengths[drone], starts[drone], known.nodes, known.before)
            turn = poses[drone, 2] if env.settings.observation.axes == "heading" else 0.0
            chosen = None if frontiers is None else _first_by(frontiers[drone], known.points[path], poses[drone], turn)
            if chosen is None:
                x, y, _ = poses[drone]
                at = ahead(path, known.points, x, y, known.clear, column0, row0)
                directions[drone] = known.points[at] - poses[drone, :2]
            else:
                directions[drone] = _turned(chosen, turn)


def _points(known: Clairvoyant, poses: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the lattice points nearest to poses or places `[n, 2 or 3]`."""
    return np.array([known.nearest(x, y) for x, y in poses[:, :2]])


def _turned(vectors: NDArray[np.floating], angle: float) -> NDArray[np.float64]:
    """Return vectors `[..., 2]` turned by an angle."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.asarray(vectors @ np.array([[cosine, sine], [-sine, cosine]]), np.float64)


def _first_by(
    frontiers: NDArray[np.float32], path: NDArray[np.float64], pose: NDArray[np.float64], turn: float
) -> NDArray[np.float32] | None:
    """Return the direction of the frontier that a path `[n, 2]` comes by first, or else nearest; None where by none.

    `frontiers` `[n, numbers]` as they are shown to the drone at `pose`, along axes turned by `turn`.
    """
    shown: NDArray[np.float32] = frontiers[frontiers[:, 0] > 0.5]
    if not len(shown):
        return None
    places = pose[:2] + _turned(shown[:, OFFSETS : OFFSETS + 2] * OFFSET_M, turn)
    apart = np.hypot(path[:, None, 0] - places[:, 0], path[:, None, 1] - places[:, 1])
    near = apart < _BY_M
    if near.any():
        first = np.where(near.any(axis=0), near.argmax(axis=0), len(path)).argmin()
    elif apart.min() < _NEAR_BY_M:
        first = apart.min(axis=0).argmin()
    else:
        return None
    direction: NDArray[np.float32] = shown[first, 1:3]
    return direction


@numba.njit(cache=True, nogil=True)
def _actions_toward(actions, directions, poses, parameters, hold_s):  # type: ignore[no-untyped-def]
    """Fill `actions` `[worlds, drones, size]` with flights along map directions, where these are not zero."""
    for world in range(actions.shape[0]):
        for drone in range(actions.shape[1]):
            x, y = directions[world, drone]
            length = math.hypot(x, y)
            if length > 0.0:
                numbers = action_toward_kernel(x / length, y / length, parameters, poses[world, drone, 2], hold_s)
                for k in range(actions.shape[2]):
                    actions[world, drone, k] = numbers[k]
