"""Who goes where: a drone deals the targets it knows out to itself and the peers it knows of, and takes its own."""

from __future__ import annotations

import math

import numba
import numpy as np

from imagine.train.baselines.survey import claim, expected_gain

LEAST_UTILITY = 1e-6
"""Utility of what shows nothing: the way decides among such targets."""


@numba.njit(cache=True, nogil=True)
def coordinated_target(ways, utility, targets, states, robots, count, left, rays, options):  # type: ignore[no-untyped-def]
    """Return the index of the target that robot 0 gets in the greedy dealing of Burgard et al. (2005); -1 for none.

    Robot and target of the greatest worth, utility less weighted way, come first; what can be seen from that target is
    then worth less to all others. `ways` float64 `[robots, targets]` metres, inf where there is none; `utility`
    float64 `[targets]` and `left` (float32, of the grid's shape, see `expected_gain`) are overwritten; `options` are
    (cost weight, form, gain exponent, gain reach in cells, share that is taken off).
    """
    weight, form, exponent, reach, share = options
    served = np.zeros(robots, np.bool_)
    left[:] = np.float32(1.0)
    for _ in range(robots):
        best, best_robot, best_target = -np.inf, -1, -1
        for target in range(count):
            for robot in range(robots):
                if served[robot] or ways[robot, target] == np.inf:
                    continue
                worth = worth_of(utility[target], weight * ways[robot, target], form)
                if worth > best:
                    best, best_robot, best_target = worth, robot, target
        if best_robot <= 0:
            return best_target
        served[best_robot] = True
        if share > 0.0:
            claim(left, states, targets[best_target], reach, rays, share)
            for target in range(count):
                if utility[target] > 0.0:
                    utility[target] = expected_gain(states, left, targets[target], reach, rays) ** exponent
        utility[best_target] = 0.0
    return -1


@numba.njit(cache=True, nogil=True)
def worth_of(utility, cost, form):  # type: ignore[no-untyped-def]
    """Return what a target of this utility is worth at this weighted way, by `Parameters.form`."""
    if form == 0:
        return utility - cost
    utility = max(utility, LEAST_UTILITY)
    return math.log(utility) - cost if form == 1 else math.log(utility) - math.log(max(1.0 + cost, 0.01))
