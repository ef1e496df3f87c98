"""The compiled loops of what drones know beyond their maps, over worlds `first` to `last` and their drones.

Each calls for every drone the very kernel that its runner calls on board.
"""

from __future__ import annotations

import numba
import numpy as np

from imagine.core.action import intent_kernel
from imagine.core.frontier_choice import fill_frontiers
from imagine.core.observation import MOTION, fill_options
from imagine.core.visits import count_peer_visits, count_visit, fill_visits


@numba.njit(cache=True, nogil=True)
def take_decisions(first, last, intents, actions, parameters, poses):  # type: ignore[no-untyped-def]
    """Turn actions `[world, drone, size]` into `intents` (float64 `[world, drone, 3]`), as taken at `poses`."""
    size = actions.shape[2]
    for world in range(first, last):
        for drone in range(actions.shape[1]):
            numbers = actions[world, drone]
            third = np.float64(numbers[2]) if size > 2 else 0.0
            x, y, yaw = poses[world, drone]
            a, b, c = intent_kernel(np.float64(numbers[0]), np.float64(numbers[1]), third, parameters, x, y, yaw)
            intents[world, drone, 0], intents[world, drone, 1], intents[world, drone, 2] = a, b, c


@numba.njit(cache=True, nogil=True)
def hear_peers(first, last, positions, ages, explorer_ages, peers, ticks, ticks_per_s, active):  # type: ignore[no-untyped-def]
    """Note what drones were told of their peers by `ticks` `[world]`, as `onboard.teammates` does from their nodes.

    `positions` float64 `[world, drone, peer, 2]` and `ages` `[world, drone, peer]` as in `PeerPoses`, where a peer
    that never said where it is has an age of inf; in `explorer_ages` so has one that has yet to say that it explores.
    `peers` are the air's PEER records `[world, drone, peer]`.
    """
    drones = positions.shape[1]
    for world in range(first, last):
        if not active[world]:
            continue
        now = ticks[world] / ticks_per_s
        for drone in range(drones):
            for peer in range(drones):
                told = peers[world, drone, peer]
                if told.pose_tick < 0:
                    continue
                positions[world, drone, peer, 0], positions[world, drone, peer, 1] = told.x, told.y
                ages[world, drone, peer] = now - told.heard_tick / ticks_per_s
                if told.status_tick >= 0:
                    explorer_ages[world, drone, peer] = ages[world, drone, peer]


@numba.njit(cache=True, nogil=True)
def count_visits(first, last, own, peers, team, positions, ages, poses, origins, alive, active):  # type: ignore[no-untyped-def]
    """Add a tick to every living drone's visits: `own`, and with `team` also `peers` (uint16 `[world, drone, r, c]`).

    `alive` bool `[world, drone]`; the grids' origins `[world, 2]` in map cells.
    """
    for world in range(first, last):
        if not active[world]:
            continue
        column0, row0 = origins[world]
        for drone in range(poses.shape[1]):
            if not alive[world, drone]:
                continue
            count_visit(own[world, drone], column0, row0, poses[world, drone, 0], poses[world, drone, 1])
            if team:
                count_peer_visits(peers[world, drone], column0, row0, positions[world, drone], ages[world, drone])


@numba.njit(cache=True, nogil=True)
def fill_option_numbers(first, last, motion, positions, ages, poses, options):  # type: ignore[no-untyped-def]
    """Fill what of `motion` (float32 `[world, drone, numbers]`) the options add."""
    for world in range(first, last):
        for drone in range(motion.shape[1]):
            x, y, yaw = poses[world, drone]
            fill_options(motion[world, drone, MOTION:], x, y, yaw, positions[world, drone], ages[world, drone], options)


@numba.njit(cache=True, nogil=True)
def fill_visit_views(  # type: ignore[no-untyped-def]
    first, last, views, own, peers, team, origins, poses, heading_axes, scales, levels
):
    """Fill what of `views` (float32 `[world, drone, channels, n, n]`) lies behind the maps: the visits."""
    maps = 2 * len(scales)
    for world in range(first, last):
        for drone in range(views.shape[1]):
            x, y, yaw = poses[world, drone]
            fill_visits(
                views[world, drone, maps:], own[world, drone], peers[world, drone], team,
                origins[world, 0], origins[world, 1], x, y, yaw if heading_axes else 0.0, scales, levels,
            )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def fill_frontier_choices(  # type: ignore[no-untyped-def]
    first,
    last,
    frontiers,
    kinds,
    states,
    belief,
    origins,
    poses,
    positions,
    ages,
    memory_s,
    heading_axes,
    shown,
    scratch,
):
    """Fill `frontiers` (float32 `[world, drone, n, numbers]`) with what drones can choose from in `shown` worlds."""
    for world in range(first, last):
        if not shown[world]:
            continue
        for drone in range(frontiers.shape[1]):
            x, y, yaw = poses[world, drone]
            fill_frontiers(
                frontiers[world, drone], kinds[world, drone], states[world, drone], belief[world, drone],
                origins[world, 0], origins[world, 1], x, y, yaw if heading_axes else 0.0, positions[world, drone],
                ages[world, drone], memory_s, scratch,
            )  # fmt: skip
