"""The frontier planner for all drones of many worlds: the baseline, and the teacher of imitation."""

from __future__ import annotations

import numba

from imagine.core.action import action_toward_kernel
from imagine.core.planner import plan_kernel


@numba.njit(cache=True, nogil=True)
def plan_worlds(first, last, actions, maps, poses, alive, ranges, lidar, parameters, hold_s):  # type: ignore[no-untyped-def]
    """Fill the actions (float32 `[worlds, drones, size]`) of worlds first to last; where there is none they stay.

    Each drone plans on the frontier field of its own belief (`maps`), as its runner's rescue does in flight; `lidar`
    is (least range, bearing of beam 0, angle between beams), `hold_s` how long a decision stands past its first tick.
    """
    range_min, start, increment = lidar
    for world in range(first, last):
        for drone in range(actions.shape[1]):
            if not alive[world, drone]:
                continue
            x, y, yaw = poses[world, drone, 0], poses[world, drone, 1], poses[world, drone, 2]
            ux, uy, found = plan_kernel(
                maps.cost[world, drone], maps.states[world, drone], maps.origins[world, 0], maps.origins[world, 1],
                x, y, yaw, ranges[world, drone], range_min, start, increment,
            )  # fmt: skip
            if found:
                numbers = action_toward_kernel(ux, uy, parameters, yaw, hold_s)
                for k in range(actions.shape[2]):
                    actions[world, drone, k] = numbers[k]
