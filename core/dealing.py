"""Who goes where: a drone deals the targets it knows out to itself and the peers it knows of, and takes its own."""

from __future__ import annotations

import math

import numba
import numpy as np

from imagine.core.frontier_targets import distance_m, in_sight


@numba.njit(cache=True, nogil=True)
def coordinated_target(ways, utility, targets, states, robots, count, options):  # type: ignore[no-untyped-def]
    """Return the index of the target that robot 0 gets in the dealing of `deal`; -1 for none.

    `ways` float64 `[robots, targets]` and `utility` `[targets]` count up to `robots` and `count`; `options` (cost
    weight, logarithmic, discount range).
    """
    weight, logarithmic, discount_range = options
    dealt = np.full(robots, -1)
    deal(dealt, ways[:robots, :count], utility[:count], targets[:count], states, weight, logarithmic, discount_range)
    return dealt[0]


@numba.njit(cache=True, nogil=True)
def deal(dealt, ways, utility, targets, states, weight, logarithmic, discount_range):  # type: ignore[no-untyped-def]
    """Deal targets out to robots greedily until robot 0 has its own (Burgard et al. 2005): fill `dealt` `[robots]`.

    Robot and target of the greatest worth, utility less weighted way, come first; then what can be seen from that
    target is worth less to all others, in proportion to how near it is. `ways` float64 `[robots, targets]` metres,
    inf where there is none; `utility` float64 `[targets]` is lowered; `dealt` holds -1 where a robot has none yet.
    """
    columns = states.shape[1]
    robots, count = ways.shape
    for _ in range(robots):
        best, best_robot, best_target = -np.inf, -1, -1
        for target in range(count):
            worth = math.log(max(utility[target], 1e-9)) if logarithmic else utility[target]
            for robot in range(robots):
                if dealt[robot] < 0 and ways[robot, target] < np.inf and worth - weight * ways[robot, target] > best:
                    best, best_robot, best_target = worth - weight * ways[robot, target], robot, target
        if best_robot < 0:
            return
        dealt[best_robot] = best_target
        if best_robot == 0:
            return
        for target in range(count):
            apart = distance_m(targets[target], targets[best_target], columns)
            if target == best_target:
                utility[target] = 0.0
            elif apart < discount_range and in_sight(states, targets[best_target], targets[target]):
                utility[target] *= apart / discount_range
