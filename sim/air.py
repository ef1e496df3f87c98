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
from imagine.sim.radio import RadioSettings
from imagine.sim.randomisation import draw

SCAN, TILES, DIGEST, STATUS = 0, 1, 2, 3
"""Kinds of messages, in the order of `bytes_sent`."""
BYTES_SENT, CELLS_KNOWN, MESSAGES_SENT = 0, 4, 7
"""Where in `counters` the four of bytes, the three of cells, and the four of messages begin."""
OWN_SCAN, PEER_SCAN, PEER_TILE = CELLS_KNOWN, CELLS_KNOWN + 1, CELLS_KNOWN + 2
"""Where in `counters` it stands who first made a cell known."""
NEVER = -(2**30)
"""The tick of what has not happened yet."""
UNIT_TILES = 256
"""A digest is cut into datagrams at multiples of so many tiles of a source."""
MOST_DRONES = 32
MOST_WANTED = 512
"""A node plans to send so many tiles at once, as in `mesh_comm.tile_exchange`."""
_MOST_MESSAGES, _MOST_SCANS, _MOST_TILES, _MOST_DIGESTS = 64, 16, 96, 8  # in flight at once, per sender


def _record(**fields: type) -> np.dtype[np.void]:
    return np.dtype(list(fields.items()), align=True)


_INT, _FLOAT = np.int64, np.float64
NODE = _record(
    tokens=_FLOAT, busy_until=_FLOAT, next_status=_FLOAT, next_digest=_FLOAT, next_scan=_FLOAT, next_plan=_FLOAT,
    scan_clock=_INT, pending_clock=_INT, pending_bytes=_INT, pending_slot=_INT, canvas=_INT, sequence=_INT,
    dropped=_INT, wanted=_INT, digest_unit=_INT, digest_units=_INT, digest_parts=_INT,
    first_message=_INT, messages=_INT, busy_slots=_INT, scans=_INT,
    first_tile=_INT, tiles=_INT, first_digest=_INT, digests=_INT, scans_ahead=_INT,
    claimed_clock=_INT, told_cells=_INT, next_repeats=_FLOAT, digest_at=_FLOAT, digest_bytes=_INT,
    pose_told_at=_FLOAT, readers=_INT,
)  # fmt: skip
"""What a drone's mesh node keeps: `tokens` bytes left to send, `busy_until` and `next_...` seconds, `pending_...` of a
scan that waits to be sent (clock 0 for none); `canvas` the slot of scans that the next one is drawn in; `busy_slots` a
bit for each slot in flight; `wanted` tiles are queued; `scans_ahead` scans went out while they waited; own cells are
counted up to `claimed_clock`, and `told_cells` of them were by the last scan sent; the last digest
was begun at `digest_at` and took `digest_bytes`; the own pose was told at `pose_told_at`; `readers` has a bit for
each peer that the last plan was for; rings have a first and a count. `dropped` messages found the
radio's queue full."""
PEER = _record(
    heard_tick=_INT, pose_tick=_INT, status_tick=_INT, digest_tick=_INT, hears=_INT,
    x=_FLOAT, y=_FLOAT, yaw=_FLOAT, vx=_FLOAT, vy=_FLOAT,
)  # fmt: skip
"""What a drone knows of another: when it heard it, its pose, its status, its digest (NEVER before the first), whom it
hears (a bit for each drone), and pose and velocity as last told."""
LINK = _record(delivered=_INT, delivered_bytes=_INT, lost=_INT, lost_bytes=_INT, out_of_range=_INT, ticks=_INT)
"""What became of the messages from one drone to another, and for how many ticks the two were in reach."""
MESSAGE = _record(
    arrival=_FLOAT, x=_FLOAT, y=_FLOAT, yaw=_FLOAT, vx=_FLOAT, vy=_FLOAT, sequence=_INT, hears=_INT,
    kind=np.int32, size=np.int32, slot=np.int32, source=np.int32, count=np.int32,
    first_unit=np.int32, last_unit=np.int32,
)  # fmt: skip
"""A message in flight. `slot` belongs to scans; of tiles 1 says that they are sketches, and of statuses that only the
pose is told. `source` and `count` belong to tiles, the units to digests, `hears` and the velocity to statuses."""
WINDOW = _record(row=_INT, column=_INT, clock=_INT, x=_FLOAT, y=_FLOAT, yaw=_FLOAT)
"""A scan in flight: the grid's row and column of its first mark (a whole number of tiles; both may lie off the grid),
the sender's clock after the scan, and its pose."""
TILE_NOTE = _record(
    sent_version=np.uint32,
    sent_tick=np.int32,
    cost_version=np.uint32,
    cost=np.int16,
    sent_known=np.int16,
    provisional=np.uint8,
)
"""What a drone notes of a source's tile: which version was sent last and when (by itself or by another that it heard),
what a version costs in bytes, how many cells it knew when sent last, and whether scans were drawn on it ahead."""


BUDGET, LOSS, CLEAR_M, WALLED_M, BUDGET_DB, EXPONENT, WALL_DB = range(7)
"""Columns of `media`: bytes a second that a drone may send, chance of loss, and the fields of Propagation."""


class AirRules(NamedTuple):
    """The settings that are alike in all worlds, as plain numbers: bytes, seconds, metres; rates per second."""

    ticks_per_s: float
    shares: bool
    relays: bool
    budget_rate: float
    burst: float
    status_period: float
    pose_period: float
    near_pose_period: float
    near: float
    digest_period: float
    scan_period: float
    tile_period: float
    peer_timeout: float
    air_rate: float
    latency: float
    queue_bytes: float
    range_min: float
    range_cap: float


class AirState(NamedTuple):
    """All arrays of the air, for kernels to take whole; `[worlds, drones, ...]`.

    `media` `[worlds, 7]` are the radio's numbers that may differ, columns BUDGET to WALL_DB.

    For others to read: `reach` uint8 `[..., drones]`, who hears whom this tick; `links` LINK and `peers` PEER
    `[..., drones]`; `counters` int64 `[..., 11]`. The rest: `nodes` NODE; `messages` MESSAGE, a ring; slots of scans,
    with `windows` WINDOW, `marks` int8 `[..., rows, columns]` and the `spans` of rows that hold any; rings of tiles
    (`tile_cells` int8, `tile_keys` place and version) and of digests (uint32 `[..., source, tile]`); `holdings` uint32
    `[..., peer, source, tile]` the versions that peers are known to hold, and `met` uint32 `[..., peer, tile]` the own
    versions when a peer came into reach; `notes` TILE_NOTE `[..., source, tile]`;
    `sketched` int16 `[..., peer, source, tile]` the cells of what was passed on unconfirmed, only for relays;
    `wanted` int64 the queue of tiles; `known` int8 `[..., row, column]` the cells that ever had evidence; `confirmed`
    int8 `[..., source, row, column]` the cells of tiles as their source sent them, kept only for passing on.
    """

    rules: AirRules
    media: NDArray[np.float64]
    reach: NDArray[np.uint8]
    links: NDArray[np.void]
    peers: NDArray[np.void]
    counters: NDArray[np.int64]
    nodes: NDArray[np.void]
    messages: NDArray[np.void]
    windows: NDArray[np.void]
    marks: NDArray[np.int8]
    spans: NDArray[np.int16]
    tile_cells: NDArray[np.int8]
    tile_keys: NDArray[np.int64]
    digests: NDArray[np.uint32]
    holdings: NDArray[np.uint32]
    met: NDArray[np.uint32]
    notes: NDArray[np.void]
    sketched: NDArray[np.int16]
    wanted: NDArray[np.int64]
    known: NDArray[np.int8]
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

        `mesh.rate_bytes_per_s` is the most that any world's drones may send. Raises InputError on more drones than one
        status can tell of.
        """
        if not 1 <= drones <= MOST_DRONES:
            raise InputError(f"the air holds 1 to {MOST_DRONES} drones a world, got {drones}")
        if mesh.scheduler != "information":
            raise InputError(f"the air of batches knows no scheduler '{mesh.scheduler}': only `information`")
        self.rules = _rules(radio, mesh, lidar, range_cap_m, tick_s)
        self._radio = radio
        self.state = _allocate(worlds, drones, tile_rows, tile_columns, self.rules)
        for world in range(worlds):
            self.clear(world)

    def clear(self, world: int, radio: RadioSettings | None = None, budget_bytes_per_s: float | None = None) -> None:
        """Let everyone in a world forget everything, with nothing in flight.

        Range and loss are from now on those of `radio`, of ranges the middle, and the bytes a second that a drone may
        send `budget_bytes_per_s`; by default those that the air was made with.
        """
        for name, array in self.state._asdict().items():
            if name != "rules":
                array[world] = np.zeros((), array.dtype)  # a zero of any kind, records among them
        medium = radio or self._radio
        budget = self.rules.budget_rate if budget_bytes_per_s is None else budget_bytes_per_s
        self.state.media[world] = (budget, draw(medium.loss, None), *medium.propagation)
        for never in ("heard_tick", "pose_tick", "status_tick", "digest_tick"):
            self.state.peers[world][never] = NEVER
        self.state.notes[world]["sent_tick"] = NEVER
        nodes = self.state.nodes[world]
        nodes["digest_at"] = nodes["pose_told_at"] = -np.inf
        nodes["scans_ahead"] = 1
        nodes["canvas"] = nodes["pending_slot"] = -1
        nodes["tokens"] = self.rules.burst
        for name in ("next_status", "next_digest", "next_scan", "next_plan", "next_repeats"):
            nodes[name] = -np.inf

    @property
    def bytes_sent(self) -> NDArray[np.int64]:
        """Sealed bytes by kind (scan, tile, digest, status), `[worlds, drones, 4]`."""
        return self.state.counters[..., BYTES_SENT : BYTES_SENT + 4]

    @property
    def messages_sent(self) -> NDArray[np.int64]:
        """Messages by kind, `[worlds, drones, 4]`."""
        return self.state.counters[..., MESSAGES_SENT : MESSAGES_SENT + 4]

    @property
    def cells_known(self) -> NDArray[np.int64]:
        """Cells first known by own scans, peers' scans and tiles, `[worlds, drones, 3]`.

        Own ones are counted where others' evidence comes in; `air_receive.claim_own` counts the rest.
        """
        return self.state.counters[..., CELLS_KNOWN : CELLS_KNOWN + 3]

    @property
    def bytes_per_drone(self) -> int:
        """Memory of one drone of one world."""
        arrays = [array for name, array in self.state._asdict().items() if name != "rules"]
        worlds, drones = self.state.nodes.shape
        return math.ceil(sum(int(array.nbytes) for array in arrays) / int(worlds * drones))


def _rules(radio: RadioSettings, mesh: MeshSettings, lidar: LidarSpec, range_cap_m: float, tick_s: float) -> AirRules:
    return AirRules(
        ticks_per_s=1.0 / tick_s,
        shares=mesh.protocol != "off",
        relays=mesh.protocol == "multi-hop",
        budget_rate=mesh.rate_bytes_per_s,
        burst=mesh.burst_bytes,
        status_period=mesh.status_period_s,
        pose_period=mesh.pose_period_s,
        near_pose_period=mesh.near_pose_period_s,
        near=mesh.near_m,
        digest_period=mesh.digest_period_s,
        scan_period=mesh.scan_period_s,
        tile_period=mesh.tile_period_s,
        peer_timeout=mesh.peer_timeout_s,
        air_rate=radio.rate_bps / 8.0,
        latency=radio.latency_s,
        queue_bytes=float(radio.queue_bytes),
        range_min=lidar.range_min,
        range_cap=range_cap_m,
    )


def _allocate(worlds: int, drones: int, tile_rows: int, tile_columns: int, rules: AirRules) -> AirState:
    """Return empty arrays, rings large enough for what the byte budget lets be in flight, up to a bound."""
    tiles, rows, columns = tile_rows * tile_columns, tile_rows * TILE, tile_columns * TILE
    side = 2 * (math.ceil(rules.range_cap / CELL) + 1) + 1
    blocks = (side + TILE - 2) // TILE + 1
    tick_s = 1.0 / rules.ticks_per_s
    waiting_s = min(rules.queue_bytes, rules.burst + rules.budget_rate * tick_s) / rules.air_rate
    in_flight_s = waiting_s + rules.latency + tick_s
    parts = 1 if drones * tiles < UNIT_TILES else 4
    exchanges = drones > 1 and rules.shares
    scans = min(_MOST_SCANS, math.ceil(in_flight_s / max(rules.scan_period, tick_s)) + 2) if exchanges else 1
    digests = min(_MOST_DIGESTS, parts * (math.ceil(in_flight_s / rules.digest_period) + 1)) if exchanges else 1
    per_drone, per_peer = (worlds, drones), (worlds, drones, drones)
    return AirState(
        rules=rules,
        media=np.zeros((worlds, 7)),
        reach=np.zeros(per_peer, np.uint8),
        links=np.zeros(per_peer, LINK),
        peers=np.zeros(per_peer, PEER),
        counters=np.zeros((*per_drone, MESSAGES_SENT + 4), np.int64),
        nodes=np.zeros(per_drone, NODE),
        messages=np.zeros((*per_drone, _MOST_MESSAGES), MESSAGE),
        windows=np.zeros((*per_drone, scans), WINDOW),
        marks=np.zeros((*per_drone, scans, side, blocks * TILE), np.int8),
        spans=np.zeros((*per_drone, scans, blocks, 2), np.int16),
        tile_cells=np.zeros((*per_drone, _MOST_TILES if exchanges else 1, TILE, TILE), np.int8),
        tile_keys=np.zeros((*per_drone, _MOST_TILES if exchanges else 1, 2), np.int64),
        digests=np.zeros((*per_drone, digests, drones, tiles), np.uint32),
        holdings=np.zeros((*per_peer, drones, tiles), np.uint32),
        met=np.zeros((*per_peer, tiles), np.uint32),
        notes=np.zeros((*per_peer, tiles), TILE_NOTE),
        sketched=np.zeros((*per_peer, drones, tiles) if rules.relays else (worlds, 1, 1, 1, 1), np.int16),
        wanted=np.zeros((*per_drone, (2 if rules.relays else 1) * drones * tiles), np.int64),
        known=np.zeros((*per_drone, rows, columns), np.int8),
        confirmed=np.zeros((*per_peer, rows, columns) if rules.relays else (worlds, 1, 1, 1, 1), np.int8),
    )
