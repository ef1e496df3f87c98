"""The compiled loops of frontier baselines over worlds `first` to `last`: survey, deal, fly; one after the other.

`state` is a `PlanState`, `maps` are the `MapArrays` of the twin, `poses` `[worlds, drones, 3]` what drones take theirs
to be. Every drone uses its own belief, and of its peers what the radio told it.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from imagine.core.action import action_toward_kernel, intent_kernel
from imagine.core.dealing import coordinated_target
from imagine.core.frontier import PAD, PLAN_CELL, UNIT_M
from imagine.core.frontier_gaps import fill_flyable
from imagine.core.frontier_paths import FAR, FRONTIER
from imagine.core.frontier_targets import distance_m, expected_gain, fill_ways, find_targets, nearest_open
from imagine.core.frontier_ways import follow, trace_back
from imagine.train.baselines.courtesy import keep_right
from imagine.train.baselines.plan_state import DUE

_OWN_RINGS, _PEER_RINGS = 4, 12
_STILL_M, _STILL_DECISIONS, _BANNED_DECISIONS = 0.3, 20, 400  # turning round on the spot takes 10 decisions at most
_GOAL_CELLS = 2


@numba.njit(cache=True, nogil=True)
def _cell_of(x, y, origin):  # type: ignore[no-untyped-def]
    """Return (row, column) of the padded grid for a point in metres, as floats; whole numbers are cells' edges."""
    return y / PLAN_CELL - origin[1] // 2 + PAD, x / PLAN_CELL - origin[0] // 2 + PAD


@numba.njit(cache=True, nogil=True)
def _is_gone(kinds, goal):  # type: ignore[no-untyped-def]
    """Tell whether no frontier is left within two cells of a flat cell."""
    rows, columns = kinds.shape
    row, column = goal // columns, goal % columns
    for i in range(max(PAD, row - _GOAL_CELLS), min(rows - PAD, row + _GOAL_CELLS + 1)):
        for j in range(max(PAD, column - _GOAL_CELLS), min(columns - PAD, column + _GOAL_CELLS + 1)):
            if kinds[i, j] & FRONTIER:
                return False
    return True


@numba.njit(cache=True, nogil=True)
def _watch(state, world, drone, x, y, followed):  # type: ignore[no-untyped-def]
    """Ban the goal of a drone that does as it is told and gets nowhere."""
    anchor = state.anchor[world, drone]
    moved = math.sqrt((x - anchor[0]) ** 2 + (y - anchor[1]) ** 2)
    state.still[world, drone] += 1
    if not followed or not moved < _STILL_M:
        anchor[0], anchor[1] = x, y
        state.still[world, drone] = 0
    for k in range(state.banned.shape[2]):
        if state.until[world, drone, k] <= state.clock[world, drone]:
            state.banned[world, drone, k] = -1
    if state.still[world, drone] >= _STILL_DECISIONS and state.goal[world, drone] >= 0:
        k = int(np.argmin(state.until[world, drone]))
        state.banned[world, drone, k] = state.goal[world, drone]
        state.until[world, drone, k] = state.clock[world, drone] + _BANNED_DECISIONS
        state.still[world, drone] = 0
        state.goal[world, drone] = -1
        state.age[world, drone] = DUE


@numba.njit(cache=True, nogil=True)
def survey_worlds(  # type: ignore[no-untyped-def]
    first, last, state, maps, poses, alive, intents, peers, ticks, ticks_per_s, parameters, rays, scratch
):
    """See whose choice is due, and fill `targets`, `ways` and `utility` of those."""
    for world in range(first, last):
        for drone in range(poses.shape[1]):
            state.due[world, drone] = False
            if not alive[world, drone]:
                continue
            x, y = poses[world, drone, 0], poses[world, drone, 1]
            kinds = maps.kinds[world, drone]
            told, stands = state.told[world, drone], intents[world, drone]
            followed = abs(told[0] - stands[0]) + abs(told[1] - stands[1]) < 0.02
            state.clock[world, drone] += 1
            state.age[world, drone] += 1
            _watch(state, world, drone, x, y, followed)
            goal, age = state.goal[world, drone], state.age[world, drone]
            if age < parameters.least_ticks:
                continue
            if goal >= 0 and age < parameters.replan_ticks and not _is_gone(kinds, goal):
                continue
            state.due[world, drone] = True
            state.found[world, drone], state.robots[world, drone] = 0, 1
            if not maps.frontiers[world, drone]:
                continue
            _survey(state, maps, world, drone, x, y, peers, ticks[world], ticks_per_s, parameters, rays, scratch)


@numba.njit(cache=True, nogil=True)
def _survey(state, maps, world, drone, x, y, peers, tick, ticks_per_s, parameters, rays, scratch):  # type: ignore[no-untyped-def]
    kinds, states, origin = state.kinds[world, drone], maps.states[world, drone], maps.origins[world]
    fill_flyable(kinds, maps.kinds[world, drone], states, maps.belief[world, drone])
    targets, ways, utility = state.targets[world, drone], state.ways[world, drone], state.utility[world, drone]
    columns = kinds.shape[1]
    row, column = _cell_of(x, y, origin)
    start = nearest_open(kinds, math.floor(row), math.floor(column), _OWN_RINGS)
    if start < 0:
        return
    cost = state.cost[world, drone]
    fill_ways(cost, kinds, start, scratch.search)
    radius = round(parameters.cluster_m / PLAN_CELL)
    count = find_targets(targets, kinds, cost, state.banned[world, drone], radius, scratch.marks, scratch.queue)
    state.found[world, drone] = count
    if count == 0:
        return
    flat = cost.ravel()
    scratch.left[:] = np.float32(1.0)
    reach = round(parameters.gain_range_m / PLAN_CELL)
    stays, nearest = -1, parameters.cluster_m
    for k in range(count):
        ways[0, k] = flat[targets[k]] * UNIT_M
        utility[k] = 1.0
        if parameters.gain_exponent > 0.0:
            utility[k] = expected_gain(states, scratch.left, targets[k], reach, rays) ** parameters.gain_exponent
        if state.goal[world, drone] >= 0:
            apart = distance_m(targets[k], state.goal[world, drone], columns)
            if apart < nearest:
                stays, nearest = k, apart
    if stays >= 0:
        ways[0, stays] = ways[0, stays] - parameters.stay_m
    robots = 1
    for peer in range(peers.shape[2]):
        told = peers[world, drone, peer]
        if peer == drone or told.pose_tick < 0 or (tick - told.heard_tick) / ticks_per_s > parameters.peer_age_s:
            continue
        row, column = _cell_of(told.x, told.y, origin)
        start = nearest_open(kinds, math.floor(row), math.floor(column), _PEER_RINGS)
        if start < 0:
            continue
        fill_ways(scratch.cost, kinds, start, scratch.search)
        flat = scratch.cost.ravel()
        for k in range(count):
            ways[robots, k] = flat[targets[k]] * UNIT_M if 0 <= flat[targets[k]] < FAR else np.inf
        robots += 1
    state.robots[world, drone] = robots


@numba.njit(cache=True, nogil=True)
def deal_worlds(first, last, state, maps, parameters, rays, scratch):  # type: ignore[no-untyped-def]
    """Deal targets out by `coordinated_target` where a choice is due."""
    options = (
        parameters.cost_weight_per_m, parameters.form, parameters.gain_exponent,
        round(parameters.gain_range_m / PLAN_CELL), parameters.claimed_share,
    )  # fmt: skip
    for world in range(first, last):
        for drone in range(state.due.shape[1]):
            if state.due[world, drone]:
                state.dealt[world, drone] = coordinated_target(
                    state.ways[world, drone], state.utility[world, drone], state.targets[world, drone],
                    maps.states[world, drone], state.robots[world, drone], state.found[world, drone], scratch.left,
                    rays, options,
                )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def fly_worlds(  # type: ignore[no-untyped-def]
    first, last, actions, state, maps, poses, alive, peers, ticks, ticks_per_s, action_parameters, hold_s
):
    """Take up what was dealt, and fill the `actions` (float32 `[worlds, drones, size]`) of those who have a goal.

    Drones that meet keep to the right, as far as `peers` (PEER records `[worlds, drones, drones]`) tell; `ticks_per_s`
    0 stands for no radio.
    """
    speed = action_parameters[2]
    for world in range(first, last):
        for drone in range(poses.shape[1]):
            if not alive[world, drone]:
                continue
            kinds, states = state.kinds[world, drone], maps.states[world, drone]
            x, y, yaw = poses[world, drone, 0], poses[world, drone, 1], poses[world, drone, 2]
            row, column = _cell_of(x, y, maps.origins[world])
            path = state.path[world, drone]
            if state.due[world, drone]:
                dealt = state.dealt[world, drone]
                state.goal[world, drone] = -1
                state.age[world, drone] = state.at[world, drone] = 0
                if dealt >= 0:
                    goal = state.targets[world, drone, dealt]
                    state.goal[world, drone] = goal
                    state.length[world, drone] = trace_back(path, state.cost[world, drone], kinds, goal)
            if state.goal[world, drone] < 0 or state.length[world, drone] == 0:
                continue
            d_row, d_column, at, lost = follow(
                path, state.length[world, drone], state.at[world, drone], kinds, states, row, column
            )  # fmt: skip
            state.at[world, drone] = at
            if lost:
                state.age[world, drone] = DUE
            length = math.sqrt(d_row * d_row + d_column * d_column)
            if length < 1e-6:
                continue
            dx, dy = d_column / length, d_row / length
            if ticks_per_s > 0.0:
                dx, dy = keep_right(dx, dy, drone, x, y, peers[world, drone], ticks[world], ticks_per_s, speed)
            numbers = action_toward_kernel(dx, dy, action_parameters, yaw, hold_s)
            for k in range(actions.shape[2]):
                actions[world, drone, k] = numbers[k]
            intent = intent_kernel(numbers[0], numbers[1], numbers[2], action_parameters, x, y, yaw)
            state.told[world, drone, 0], state.told[world, drone, 1] = intent[0], intent[1]
