"""Who goes where: a drone deals the targets it knows out to itself and the peers it knows of, and takes its own."""

from __future__ import annotations

import math

import numba
import numpy as np

from imagine.core.frontier_targets import claim, expected_gain

LEAST_UTILITY = 1e-6
"""Utility of what shows nothing: the way decides among such targets."""


@numba.njit(cache=True, nogil=True)
def coordinated_target(ways, utility, targets, states, robots, count, left, rays, options):  # type: ignore[no-untyped-def]
    """Return the index of the target that robot 0 gets in the dealing of `deal`; -1 for none.

    `ways` float64 `[robots, targets]` and `utility` `[targets]` count up to `robots` and `count`.
    """
    dealt = np.full(robots, -1)
    deal(dealt, ways[:robots, :count], utility[:count], targets[:count], states, left, rays, options, rays, 1)
    return dealt[0]


@numba.njit(cache=True, nogil=True)
def deal(dealt, ways, utility, targets, states, left, rays, options, gain_rays, stride):  # type: ignore[no-untyped-def]
    """Deal targets out to robots greedily until robot 0 has its own (Burgard et al. 2005): fill `dealt` `[robots]`.

    Robot and target of the greatest worth, utility less weighted way, come first; what can be seen from that target is
    then worth less to all others. `dealt` holds -1 where a robot has none yet; `ways` float64 `[robots, targets]`
    metres, inf where there is none; `utility` float64 `[targets]` and `left` (float32, of the grid's shape, see
    `expected_gain`) are overwritten; `options` are (cost weight, form, gain exponent, gain reach in cells, share that
    is taken off). What is taken off is looked for along `rays`, what is left along `gain_rays` by `stride` cells.
    """
    weight, form, exponent, reach, share = options
    robots, count = ways.shape
    left[:] = np.float32(1.0)
    for _ in range(robots):
        best, best_robot, best_target = -np.inf, -1, -1
        for target in range(count):
            for robot in range(robots):
                if dealt[robot] >= 0 or ways[robot, target] == np.inf:
                    continue
                worth = worth_of(utility[target], weight * ways[robot, target], form)
                if worth > best:
                    best, best_robot, best_target = worth, robot, target
        if best_robot < 0:
            return
        dealt[best_robot] = best_target
        if best_robot == 0:
            return
        if share > 0.0:
            claim(left, states, targets[best_target], reach, rays, share)
            for target in range(count):
                if utility[target] > 0.0:
                    gain = expected_gain(states, left, targets[target], reach, gain_rays, stride)
                    utility[target] = gain**exponent
        utility[best_target] = 0.0


@numba.njit(cache=True, nogil=True)
def worth_of(utility, cost, form):  # type: ignore[no-untyped-def]
    """Return what a target of this utility is worth at this weighted way, by `Parameters.form`."""
    if form == 0:
        return utility - cost
    utility = max(utility, LEAST_UTILITY)
    return math.log(utility) - cost if form == 1 else math.log(utility) - math.log(max(1.0 + cost, 0.01))
