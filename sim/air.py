"""The air between the drones of many worlds at once: what `mesh_comm` and `sim.radio` do, as arrays and kernels.

A served flight seals, sends and merges real datagrams. Training cannot afford that, so here a message is a record with
its size in bytes, and its content lies in small rings per sender: the marks of a scan, the cells of tiles, the tile
versions of a digest. Who sends what when, what it costs, when it arrives, whether it is lost and what the receiver
makes of it follow `mesh_comm.node.MeshNode` and `sim.radio.RadioMedium`; sizes are estimates (`sim.air_costs`).

`sim.air_receive.deliver` and `sim.air_send.send` are called once a tick for each world, with own scans integrated in
between. State is `[world, drone, ...]`; what is written about others is `[world, holder, other, ...]`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.lidar import LidarSpec
from imagine.core.raster import CELL, TILE
from imagine.mesh_comm.settings import MeshSettings
from imagine.sim.propagation import Propagation
from imagine.sim.radio import RadioSettings

SCAN, TILES, DIGEST, STATUS = 0, 1, 2, 3
"""Kinds of messages, in the order of `bytes_sent`."""
OWN_SCAN, PEER_SCAN, PEER_TILE = 0, 1, 2
"""Who first made a cell known, in the order of `cells_known`."""
NEVER = -(2**30)
"""The tick of what has not happened yet."""
UNIT_TILES = 256
"""A digest is cut into datagrams at multiples of so many tiles of a source."""
MOST_DRONES = 32
MOST_WANTED = 512
"""A node plans to send so many tiles at once, as in `mesh_comm.tile_exchange`."""
_MOST_MESSAGES, _MOST_SCANS, _MOST_TILES, _MOST_DIGESTS = 64, 16, 96, 8  # in flight at once, per sender

NODE = np.dtype(
    [
        ("tokens", np.float64), ("busy_until", np.float64), ("next_status", np.float64), ("next_digest", np.float64),
        ("next_scan", np.float64), ("next_plan", np.float64), ("scan_clock", np.int64), ("pending_clock", np.int64),
        ("pending_bytes", np.int64), ("claimed_clock", np.int64), ("sequence", np.int64), ("dropped", np.int64),
        ("wanted", np.int64), ("digest_unit", np.int64), ("digest_units", np.int64), ("digest_parts", np.int64),
        ("first_message", np.int64), ("messages", np.int64), ("first_scan", np.int64), ("scans", np.int64),
        ("first_tile", np.int64), ("tiles", np.int64), ("first_digest", np.int64), ("digests", np.int64),
        ("tiles_first", np.bool_),
    ], align=True,
)  # fmt: skip
"""What a drone's mesh node keeps. `tokens` are bytes, `busy_until` and `next_...` seconds; rings have a first and a
count; `pending_clock` is that of a scan that waits to be sent, 0 for none."""
MESSAGE = np.dtype(
    [
        ("arrival", np.float64), ("x", np.float64), ("y", np.float64), ("yaw", np.float64),
        ("vx", np.float64), ("vy", np.float64), ("sequence", np.int64), ("clock", np.int64), ("hears", np.int64),
        ("kind", np.int32), ("size", np.int32), ("source", np.int32), ("count", np.int32),
        ("first_unit", np.int32), ("last_unit", np.int32),
    ], align=True,
)  # fmt: skip
"""A message in flight. `clock` belongs to scans, `source` and `count` to tiles, the units to digests, `hears` (a bit
for each drone heard lately) and velocity to statuses."""
WINDOW = np.dtype(
    [
        ("row", np.int64), ("column", np.int64), ("rows", np.int64), ("blocks", np.int64), ("clock", np.int64),
        ("x", np.float64), ("y", np.float64), ("yaw", np.float64),
    ], align=True,
)  # fmt: skip
"""Where a scan's marks lie on the grid: first row, first column (whole tiles), rows, and tiles side by side."""
LINK = np.dtype(
    [
        ("delivered", np.int64), ("delivered_bytes", np.int64), ("lost", np.int64), ("lost_bytes", np.int64),
        ("out_of_range", np.int64), ("ticks", np.int64),
    ], align=True,
)  # fmt: skip
"""What became of the messages from one drone to another, and for how many ticks the two were in reach."""


class AirRules(NamedTuple):
    """The settings as plain numbers: bytes, seconds, metres; rates per second."""

    ticks_per_s: float
    shares: bool
    relays: bool
    budget_rate: float
    burst: float
    status_period: float
    digest_period: float
    scan_period: float
    tile_period: float
    peer_timeout: float
    air_rate: float
    latency: float
    loss: float
    queue_bytes: float
    range_min: float
    range_cap: float
    propagation: Propagation


class AirState(NamedTuple):
    """All arrays of the air, `[worlds, drones, ...]`, for kernels to take whole.

    For others to read: `reach` uint8 `[worlds, drones, drones]`, who hears whom; `links` the LINK counters by sender
    and receiver; `bytes_sent` and `messages_sent` by kind; `cells_known` by who made them known first; of each peer
    `heard_tick` (NEVER), `peer_pose` as last told, `peer_pose_tick` when, and `peer_velocity`.
    """

    rules: AirRules
    reach: NDArray[np.uint8]
    links: NDArray[np.void]
    bytes_sent: NDArray[np.int64]
    messages_sent: NDArray[np.int64]
    cells_known: NDArray[np.int64]
    heard_tick: NDArray[np.int64]
    peer_pose: NDArray[np.float64]
    peer_pose_tick: NDArray[np.int64]
    peer_velocity: NDArray[np.float64]
    peer_hears: NDArray[np.int64]
    digest_tick: NDArray[np.int64]
    nodes: NDArray[np.void]
    messages: NDArray[np.void]
    scan_windows: NDArray[np.void]
    scan_spans: NDArray[np.int16]
    scan_marks: NDArray[np.int8]
    tile_cells: NDArray[np.int8]
    tile_keys: NDArray[np.int64]
    digest_versions: NDArray[np.uint32]
    holdings: NDArray[np.uint32]
    sent_version: NDArray[np.uint32]
    sent_tick: NDArray[np.int64]
    wanted: NDArray[np.int64]
    cost_version: NDArray[np.uint32]
    cost: NDArray[np.int16]
    known: NDArray[np.int8]
    provisional: NDArray[np.uint8]
    confirmed: NDArray[np.int8]


class Air:
    """The radio exchange of `drones` drones in each of `worlds` worlds on grids of whole tiles; `state` for kernels."""

    def __init__(
        self,
        worlds: int,
        drones: int,
        tile_rows: int,
        tile_columns: int,
        radio: RadioSettings,
        mesh: MeshSettings,
        lidar: LidarSpec,
        range_cap_m: float,
        tick_s: float,
    ) -> None:
        """Make an air where nobody has said anything. `range_cap_m` and `lidar` describe the scans that are mapped.

        Raises InputError on more drones than one status can tell of.
        """
        if not 1 <= drones <= MOST_DRONES:
            raise InputError(f"the air holds 1 to {MOST_DRONES} drones a world, got {drones}")
        self.rules = _rules(radio, mesh, lidar, range_cap_m, tick_s)
        self.state = _allocate(worlds, drones, tile_rows, tile_columns, self.rules)
        for world in range(worlds):
            self.clear(world)

    def clear(self, world: int) -> None:
        """Let everyone in a world forget everything, with nothing in flight."""
        for name, array in self.state._asdict().items():
            if name != "rules":
                array[world] = np.zeros((), array.dtype)  # a zero of any kind, records among them
        state = self.state
        for never in (state.heard_tick, state.peer_pose_tick, state.digest_tick, state.sent_tick):
            never[world] = NEVER
        nodes = state.nodes[world]
        nodes["tokens"] = self.rules.burst
        for name in ("next_status", "next_digest", "next_scan", "next_plan"):
            nodes[name] = -np.inf

    @property
    def bytes_per_drone(self) -> int:
        """Memory of one drone of one world."""
        arrays = [array for name, array in self.state._asdict().items() if name != "rules"]
        worlds, drones = self.state.nodes.shape
        return math.ceil(sum(array.nbytes for array in arrays) / (worlds * drones))


def _rules(radio: RadioSettings, mesh: MeshSettings, lidar: LidarSpec, range_cap_m: float, tick_s: float) -> AirRules:
    return AirRules(
        ticks_per_s=1.0 / tick_s,
        shares=mesh.protocol != "off",
        relays=mesh.protocol == "multi-hop",
        budget_rate=mesh.rate_bytes_per_s,
        burst=mesh.burst_bytes,
        status_period=mesh.status_period_s,
        digest_period=mesh.digest_period_s,
        scan_period=mesh.scan_period_s,
        tile_period=mesh.tile_period_s,
        peer_timeout=mesh.peer_timeout_s,
        air_rate=radio.rate_bps / 8.0,
        latency=radio.latency_s,
        loss=radio.loss,
        queue_bytes=float(radio.queue_bytes),
        range_min=lidar.range_min,
        range_cap=range_cap_m,
        propagation=radio.propagation,
    )


def _allocate(worlds: int, drones: int, tile_rows: int, tile_columns: int, rules: AirRules) -> AirState:
    """Return empty arrays, rings large enough for what the byte budget lets be in flight, up to a bound."""
    tiles, rows, columns = tile_rows * tile_columns, tile_rows * TILE, tile_columns * TILE
    side = 2 * (math.ceil(rules.range_cap / CELL) + 1) + 1
    blocks = min((side + TILE - 2) // TILE + 1, tile_columns)
    tick_s = 1.0 / rules.ticks_per_s
    waiting_s = min(rules.queue_bytes, rules.burst + rules.budget_rate * tick_s) / rules.air_rate
    in_flight_s = waiting_s + rules.latency + tick_s
    parts = 1 if drones * tiles < UNIT_TILES else 4
    scans = min(_MOST_SCANS, math.ceil(in_flight_s / max(rules.scan_period, tick_s)) + 2)
    digests = min(_MOST_DIGESTS, parts * (math.ceil(in_flight_s / rules.digest_period) + 1))
    per_drone, per_peer = (worlds, drones), (worlds, drones, drones)
    relayed = (*per_peer, rows, columns) if rules.relays else (worlds, 1, 1, 1, 1)
    if drones == 1 or not rules.shares:
        scans = 1
    return AirState(
        rules=rules,
        reach=np.zeros(per_peer, np.uint8),
        links=np.zeros(per_peer, LINK),
        bytes_sent=np.zeros((*per_drone, 4), np.int64),
        messages_sent=np.zeros((*per_drone, 4), np.int64),
        cells_known=np.zeros((*per_drone, 3), np.int64),
        heard_tick=np.zeros(per_peer, np.int64),
        peer_pose=np.zeros((*per_peer, 3)),
        peer_pose_tick=np.zeros(per_peer, np.int64),
        peer_velocity=np.zeros((*per_peer, 2)),
        peer_hears=np.zeros(per_peer, np.int64),
        digest_tick=np.zeros(per_peer, np.int64),
        nodes=np.zeros(per_drone, NODE),
        messages=np.zeros((*per_drone, _MOST_MESSAGES), MESSAGE),
        scan_windows=np.zeros((*per_drone, scans), WINDOW),
        scan_spans=np.zeros((*per_drone, scans, blocks, 2), np.int16),
        scan_marks=np.zeros((*per_drone, scans, min(side, rows), blocks * TILE), np.int8),
        tile_cells=np.zeros((*per_drone, _MOST_TILES, TILE, TILE), np.int8),
        tile_keys=np.zeros((*per_drone, _MOST_TILES, 2), np.int64),
        digest_versions=np.zeros((*per_drone, digests, drones, tiles), np.uint32),
        holdings=np.zeros((*per_peer, drones, tiles), np.uint32),
        sent_version=np.zeros((*per_peer, tiles), np.uint32),
        sent_tick=np.zeros((*per_peer, tiles), np.int64),
        wanted=np.zeros((*per_drone, drones * tiles), np.int64),
        cost_version=np.zeros((*per_peer, tiles), np.uint32),
        cost=np.zeros((*per_peer, tiles), np.int16),
        known=np.zeros((*per_drone, rows, columns), np.int8),
        provisional=np.zeros((*per_peer, tiles), np.uint8),
        confirmed=np.zeros(relayed, np.int8),
    )
