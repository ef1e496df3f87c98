"""The stages of a tick of exploration, compiled: what happens in a world between a decision and the next observation.

In the order of a runner's tick on board: fly, scan, share (hear the peers, map, speak), derive belief and frontier
field, observe. Each stage is one kernel over worlds `first` to `last`; `modes` `[worlds]` says what a world does. No
world looks at another, so threads may share worlds out.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.action import Parameters, body_velocity_kernel
from imagine.core.observation import MOTION, fill_motion, fill_sectors, fill_views
from imagine.core.raster import CELL
from imagine.core.shield import shield_kernel
from imagine.sim.air_receive import deliver, meet, peer_place
from imagine.sim.air_send import canvas, send
from imagine.sim.odometry_drift import advance_worlds
from imagine.sim.physics import step_worlds
from imagine.sim.scan_world import scan_world
from imagine.sim.team_maps import integrate_scan_of

WAITING, FLYING, LAUNCHING = 0, 1, 2
"""What a world does in a tick: nothing, all stages, or all but flying, for what is seen at the launch."""
STAGES = ("fly", "scan", "share", "derive", "observe")


class Specs(NamedTuple):
    """Settings as the plain numbers that the kernels take."""

    parameters: Parameters
    shield: tuple[float, float, float]
    """Radius, lag and greatest acceleration of the airframe."""
    lidar: tuple[float, float, float]
    """Least range, bearing of beam 0, angle between beams."""
    scales_m: NDArray[np.float64]
    frontier_ranges_m: NDArray[np.float64]
    lidar_range_m: float
    speed_mps: float
    yaw_rate_rps: float
    heading_axes: bool


@numba.njit(cache=True, nogil=True)
def fly(first, last, modes, intents, setpoints, ranges, estimates, alive, specs, flight):  # type: ignore[no-untyped-def]
    """Turn the intents that stand into setpoints, shielded by the newest scan as in flight, and fly a tick.

    `intents` and `setpoints` float64 `[worlds, drones, 3]`, `estimates` the poses that drones take theirs to be,
    `flight` is `Twin.kernel_args()`. The dead get no setpoint.
    """
    range_min, start, increment = specs.lidar
    radius, lag, acceleration = specs.shield
    for world in range(first, last):
        if modes[world] != FLYING:
            continue
        for drone in range(intents.shape[1]):
            vx, vy, rate = 0.0, 0.0, 0.0
            if alive[world, drone]:
                vx, vy, rate = body_velocity_kernel(
                    intents[world, drone, 0], intents[world, drone, 1], intents[world, drone, 2], specs.parameters,
                    estimates[world, drone, 0], estimates[world, drone, 1], estimates[world, drone, 2],
                )  # fmt: skip
                vx, vy = shield_kernel(
                    vx, vy, ranges[world, drone], range_min, start, increment, radius, lag, acceleration
                )
            setpoints[world, drone, 0], setpoints[world, drone, 1], setpoints[world, drone, 2] = vx, vy, rate
        step_worlds(world, world + 1, setpoints, *flight)


@numba.njit(cache=True, nogil=True)
def locate(first, last, modes, estimates, poses, drift):  # type: ignore[no-untyped-def]
    """Carry what drones take their `poses` to be on by a tick; `drift` is `OdometryDrift.kernel_args()`."""
    error, before, scale, drifts, drawn, ages, numbers, normal = drift
    for world in range(first, last):
        if modes[world] != WAITING:
            advance_worlds(
                world, world + 1, estimates, poses, error, before, scale, drifts, drawn, ages, numbers, normal
            )


@numba.njit(cache=True, nogil=True)
def scan(first, last, modes, turns, ranges, sensors, poses, velocity, alive, discs, edges, radius):  # type: ignore[no-untyped-def]
    """Take a turn of every LiDAR, as `scan_world`; `turns` int64 `[worlds]` counts them, and draws their noise."""
    for world in range(first, last):
        if modes[world] != WAITING:
            turns[world] += 1
            scan_world(world, ranges, sensors, poses, velocity, alive, discs, edges, radius, turns[world])


@numba.njit(cache=True, nogil=True)
def share(first, last, modes, ticks, keys, poses, velocity, estimates, alive, ranges, maps, pens, air, levels, scratch):  # type: ignore[no-untyped-def]
    """Let arrive what was sent before, map the own scans, and send what there is to say, as a runner does in a tick.

    Peers reach each other by the true `poses`, and map by their `estimates`; `levels` is a pair of the levels' arrays
    and each world's row of them, `keys` uint64 `[worlds]` draw the losses.
    """
    arrays, rows = levels
    drones = poses.shape[1]
    places = np.empty((drones, 2))
    for world in range(first, last):
        if modes[world] == WAITING:
            continue
        row, tick = rows[world], ticks[world]
        walls = arrays.edges[row, : arrays.shape[row, 2]]
        deliver(
            air, world, tick, keys[world], poses[world], alive[world], walls, maps.layers[world], maps.versions[world],
            maps.dirty[world],
        )  # fmt: skip
        if modes[world] == LAUNCHING:
            meet(air, world, tick, estimates[world])
        for drone in range(drones):
            maps.gained[world, drone] = maps.changed[world, drone] = 0
            if not alive[world, drone]:
                continue
            for peer in range(drones):
                x, y, known = peer_place(air.peers[world, drone, peer], tick, air.rules)
                known = known and peer != drone
                places[peer, 0], places[peer, 1] = (x, y) if known else (np.nan, np.nan)
            pose = estimates[world, drone]
            own_row = math.floor(pose[1] / CELL) - maps.origins[world, 1]
            own_column = math.floor(pose[0] / CELL) - maps.origins[world, 0]
            slot, _, _ = canvas(air, world, drone, own_row, own_column)
            integrate_scan_of(
                world, drone, maps, pens, ranges[world, drone], pose, places, air.marks[world, drone, slot],
                scratch.kept,
            )  # fmt: skip
        send(
            air, world, tick, estimates[world], velocity[world], alive[world], ranges[world], maps.clocks[world],
            maps.layers[world], maps.versions[world],
        )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def observe(first, last, modes, views, sectors, motion, belief, cost, origins, estimates, velocity, ranges, specs):  # type: ignore[no-untyped-def]
    """Fill what policies see, as `core.observation` does in flight, but for what options add."""
    range_min, start, increment = specs.lidar
    channels = 2 * len(specs.scales_m)
    for world in range(first, last):
        if modes[world] == WAITING:
            continue
        for drone in range(views.shape[1]):
            x, y, yaw = estimates[world, drone, 0], estimates[world, drone, 1], estimates[world, drone, 2]
            turn = yaw if specs.heading_axes else 0.0
            fill_views(
                views[world, drone, :channels], belief[world, drone], cost[world, drone], origins[world, 0],
                origins[world, 1], x, y, turn, specs.scales_m, specs.frontier_ranges_m,
            )  # fmt: skip
            fill_sectors(
                sectors[world, drone], ranges[world, drone], range_min, start, increment, yaw - turn,
                specs.lidar_range_m,
            )  # fmt: skip
            fill_motion(
                motion[world, drone, :MOTION], velocity[world, drone, 0], velocity[world, drone, 1],
                velocity[world, drone, 2], turn, specs.speed_mps, specs.yaw_rate_rps,
            )  # fmt: skip
