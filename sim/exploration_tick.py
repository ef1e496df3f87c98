"""One tick of exploration, compiled: all that happens in a world between a decision and the next observation.

The stages run in the order of a runner's tick on board: fly, scan, hear the peers, map, derive belief and frontier
field, observe, speak. A world runs through all of them before the next one begins, so that what one stage writes is
still in the cache when the next one reads it; and no world looks at another, so threads may share worlds out.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from imagine.core.action import Parameters, body_velocity_kernel
from imagine.core.observation import MOTION, fill_motion, fill_sectors, fill_views
from imagine.core.shield import shield_kernel
from imagine.sim.air import AirState
from imagine.sim.air_receive import deliver, peer_place
from imagine.sim.air_send import send
from imagine.sim.chipmunk import call_address
from imagine.sim.physics import step_worlds
from imagine.sim.scan_world import scan_world
from imagine.sim.team_maps import MapArrays, Pens, derive, integrate_scans

WAITING, FLYING, LAUNCHING = 0, 1, 2
"""What a world does in a tick: nothing, all stages, or all but flying, for what is seen at the launch."""
PHYSICS, RAYS, HEARING, MAPPING, DERIVING, OBSERVING, SPEAKING = range(7)
STAGE_NAMES = ("physics", "rays", "radio in", "integration", "belief and field", "views", "radio out")
_CLOCK_MONOTONIC = 3  # of Linux's <time.h>


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


class Batch(NamedTuple):
    """The arrays of all worlds that a tick works on, `[worlds, drones, ...]`.

    `modes` and `ticks` `[worlds]`; `poses` and `velocity` are the truth, `estimates` what drones take their poses to
    be; `places` float64 `[worlds, drones, drones, 2]` where each takes its peers to be, nan where it does not know.
    """

    modes: NDArray[np.int64]
    ticks: NDArray[np.int64]
    scans: NDArray[np.int64]
    keys: NDArray[np.uint64]
    intents: NDArray[np.float64]
    setpoints: NDArray[np.float64]
    poses: NDArray[np.float64]
    velocity: NDArray[np.float64]
    estimates: NDArray[np.float64]
    alive: NDArray[np.bool_]
    places: NDArray[np.float64]
    ranges: NDArray[np.float32]
    views: NDArray[np.float32]
    sectors: NDArray[np.float32]
    motion: NDArray[np.float32]
    maps: MapArrays
    pens: Pens
    air: AirState


@numba.njit(cache=True, nogil=True)
def tick_worlds(first, last, observes, batch, specs, sensors, flight, discs, edges, radius, scratch):  # type: ignore[no-untyped-def]
    """Run a tick in worlds first to last, each as its mode says; fill observations only where one `observes`.

    `sensors` are `Sensing.sensors()`, `flight` is `Twin.kernel_args()`, `discs` and `edges` what moves; `scratch` is
    this thread's own.
    """
    for world in range(first, last):
        mode = batch.modes[world]
        if mode == WAITING:
            continue
        began = _lap(scratch, -1, 0)
        if mode == FLYING:
            _aim(world, batch, specs)
            step_worlds(world, world + 1, batch.setpoints, *flight)
        began = _lap(scratch, PHYSICS, began)
        batch.scans[world] += 1
        scan_world(
            world, batch.ranges, sensors, batch.poses, batch.velocity, batch.alive, discs, edges, radius,
            batch.scans[world],
        )  # fmt: skip
        began = _lap(scratch, RAYS, began)
        _hear(world, batch, sensors)
        began = _lap(scratch, HEARING, began)
        integrate_scans(
            world, batch.maps, batch.pens, batch.ranges[world], batch.estimates[world], batch.places[world],
            batch.alive[world], scratch,
        )  # fmt: skip
        began = _lap(scratch, MAPPING, began)
        derive(world, batch.maps, scratch)
        began = _lap(scratch, DERIVING, began)
        if observes:
            _observe(world, batch, specs)
        began = _lap(scratch, OBSERVING, began)
        maps = batch.maps
        send(
            batch.air, world, batch.ticks[world], batch.estimates[world], batch.velocity[world], batch.alive[world],
            batch.ranges[world], scratch.marks, scratch.corners, maps.clocks[world], maps.layers[world], maps.versions[world],
        )  # fmt: skip
        _lap(scratch, SPEAKING, began)


@numba.njit(cache=True, nogil=True)
def _lap(scratch, stage, began):  # type: ignore[no-untyped-def]
    """Add the time since `began` (ns) to a stage and return what it is now; do nothing where no clock is set."""
    if scratch.clock[0] == 0:
        return 0
    call_address(scratch.clock[0], (_CLOCK_MONOTONIC, scratch.lap.ctypes.data))
    now = scratch.lap[0] * 1_000_000_000 + scratch.lap[1]
    if stage >= 0:
        scratch.nanoseconds[stage] += now - began
    return now


@numba.njit(cache=True, nogil=True)
def _aim(world, batch, specs):  # type: ignore[no-untyped-def]
    """Turn the intents that stand into body setpoints, shielded by the newest scan as in flight; none for the dead."""
    range_min, start, increment = specs.lidar
    radius, lag, acceleration = specs.shield
    for drone in range(batch.intents.shape[1]):
        if not batch.alive[world, drone]:
            batch.setpoints[world, drone, :] = 0.0
            continue
        intent, pose = batch.intents[world, drone], batch.estimates[world, drone]
        vx, vy, rate = body_velocity_kernel(
            intent[0], intent[1], intent[2], specs.parameters, pose[0], pose[1], pose[2]
        )
        vx, vy = shield_kernel(
            vx, vy, batch.ranges[world, drone], range_min, start, increment, radius, lag, acceleration
        )
        batch.setpoints[world, drone, 0], batch.setpoints[world, drone, 1] = vx, vy
        batch.setpoints[world, drone, 2] = rate


@numba.njit(cache=True, nogil=True)
def _hear(world, batch, sensors):  # type: ignore[no-untyped-def]
    """Let arrive what was sent before, and note where everyone takes the others to be."""
    maps, levels, row = batch.maps, sensors.levels, sensors.rows[world]
    walls = levels.edges[row, : levels.shape[row, 2]]
    deliver(
        batch.air, world, batch.ticks[world], batch.keys[world], batch.poses[world], batch.alive[world], walls,
        maps.layers[world],
        maps.versions[world], maps.dirty[world],
    )  # fmt: skip
    drones, peers = batch.poses.shape[1], batch.air.peers[world]
    for drone in range(drones):
        for peer in range(drones):
            place = batch.places[world, drone, peer]
            place[0], place[1] = np.nan, np.nan
            if peer != drone:
                x, y, known = peer_place(peers[drone, peer], batch.ticks[world], batch.air.rules)
                if known:
                    place[0], place[1] = x, y


@numba.njit(cache=True, nogil=True)
def _observe(world, batch, specs):  # type: ignore[no-untyped-def]
    """Fill what the policies of a world see, as `core.observation` does in flight."""
    range_min, start, increment = specs.lidar
    maps = batch.maps
    channels = 2 * len(specs.scales_m)
    for drone in range(batch.poses.shape[1]):
        pose, velocity = batch.estimates[world, drone], batch.velocity[world, drone]
        turn = pose[2] if specs.heading_axes else 0.0
        fill_views(
            batch.views[world, drone, :channels], maps.belief[world, drone], maps.cost[world, drone],
            maps.origins[world, 0], maps.origins[world, 1], pose[0], pose[1], turn, specs.scales_m,
            specs.frontier_ranges_m,
        )  # fmt: skip
        fill_sectors(
            batch.sectors[world, drone], batch.ranges[world, drone], range_min, start, increment, pose[2] - turn,
            specs.lidar_range_m,
        )  # fmt: skip
        fill_motion(
            batch.motion[world, drone, :MOTION], velocity[0], velocity[1], velocity[2], turn, specs.speed_mps,
            specs.yaw_rate_rps,
        )  # fmt: skip
