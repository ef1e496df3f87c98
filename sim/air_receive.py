"""The receiving half of the batched air: what has arrived is heard by whom it reaches, and drawn into their maps.

As `RadioMedium.deliver` and `MeshNode.receive`. All arrays but the air's own are those of one world. Small steps take
the arrays they need and not the whole state: handing that on costs more than most of them do.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from imagine.core.raster import TILE
from imagine.sim.air import DIGEST, OWN_SCAN, PEER_SCAN, PEER_TILE, SCAN, STATUS, TILES, UNIT_TILES
from imagine.sim.air_tiles import claim_tile, copy_tile, draw_marks
from imagine.sim.propagation import fill_reach

_EXTRAPOLATE_S = 1.0  # as in mesh_comm.peers


@numba.njit(cache=True, nogil=True)
def deliver(air, world, tick, key, poses, alive, segments, layers, versions, dirty):  # type: ignore[no-untyped-def]
    """Deliver what has arrived in `world` by `tick` to all who hear it at `poses` (`[drones, 2 or more]`, metres).

    Drones not `alive` (bool `[drones]`) neither hear nor are heard.

    `segments` `[n, 4]` are the faces of the walls; `key` (uint64) draws the losses, so that a world does not depend on
    what else runs. Writes peers' evidence into `layers` (int8 `[holder, source, rows, columns]`) and `versions`
    (uint32 `[holder, source, tile rows, tile columns]`), and sets `dirty` (uint8 `[holder, tile rows, tile columns]`)
    where a holder's belief may have changed. Messages come by arrival, then sender, then order of sending.
    """
    rules = air.rules
    drones = layers.shape[0]
    reach, links, nodes, messages = air.reach[world], air.links[world], air.nodes[world], air.messages[world]
    fill_reach(reach, poses, segments, rules.propagation)
    for sender in range(drones):
        for receiver in range(drones):
            if not (alive[sender] and alive[receiver]):
                reach[sender, receiver] = 0
            links[sender, receiver].ticks += reach[sender, receiver]
    now = tick / rules.ticks_per_s
    while True:
        sender, earliest = -1, now + 1e-9
        for other in range(drones):
            if nodes[other].messages > 0:
                arrival = messages[other, nodes[other].first_message].arrival
                if arrival < earliest or (arrival == earliest and sender < 0):
                    sender, earliest = other, arrival
        if sender < 0:
            return
        node = nodes[sender]
        message = messages[sender, node.first_message]
        for receiver in range(drones):
            if receiver == sender:
                continue
            link = links[sender, receiver]
            if reach[sender, receiver] == 0:
                link.out_of_range += 1
            elif rules.loss > 0.0 and _chance(key, tick, sender, receiver, message.sequence) < rules.loss:
                link.lost += 1
                link.lost_bytes += message.size
            else:
                link.delivered += 1
                link.delivered_bytes += message.size
                peer = air.peers[world, receiver, sender]
                _hear(peer, tick, message)
                if message.kind == DIGEST:
                    peer.digest_tick = tick
                    _take_digest(air.holdings[world, receiver, sender], air.digests[world, sender, node.first_digest],
                                 sender, message)  # fmt: skip
                elif rules.shares and (message.kind == SCAN or message.kind == TILES):
                    claim_own(
                        nodes[receiver], air.counters[world, receiver], air.known[world, receiver],
                        layers[receiver, receiver], versions[receiver, receiver],
                    )  # fmt: skip
                    if message.kind == SCAN:
                        _take_scan(
                            air.windows[world, sender, node.first_scan], air.marks[world, sender, node.first_scan],
                            air.counters[world, receiver], air.known[world, receiver],
                            air.notes[world, receiver, sender], layers[receiver, sender], versions[receiver, sender],
                            dirty[receiver],
                        )  # fmt: skip
                    elif message.source == sender or message.source == receiver or rules.relays:
                        _take_tiles(air, world, tick, sender, receiver, message, layers, versions, dirty)
        if message.kind == SCAN:
            node.first_scan = (node.first_scan + 1) % air.windows.shape[2]
            node.scans -= 1
        elif message.kind == TILES:
            node.first_tile = (node.first_tile + message.count) % air.tile_cells.shape[2]
            node.tiles -= message.count
        elif message.kind == DIGEST:
            node.first_digest = (node.first_digest + 1) % air.digests.shape[2]
            node.digests -= 1
        node.first_message = (node.first_message + 1) % messages.shape[1]
        node.messages -= 1


@numba.njit(cache=True, nogil=True)
def meet(air, world, tick, poses):  # type: ignore[no-untyped-def]
    """Let drones that reach each other know of one another at `poses` (`[drones, 3]`), where an episode begins.

    In flight they have told their status, over and over, before they take off; an episode begins in the air.
    """
    drones = poses.shape[0]
    for holder in range(drones):
        for other in range(drones):
            if air.reach[world, holder, other]:
                peer = air.peers[world, holder, other]
                peer.heard_tick = peer.pose_tick = tick
                peer.x, peer.y, peer.yaw = poses[other, 0], poses[other, 1], poses[other, 2]
                for heard in range(drones):
                    peer.hears |= np.int64(air.reach[world, other, heard]) << heard


@numba.njit(cache=True, nogil=True)
def claim_all(air, world, layers, versions):  # type: ignore[no-untyped-def]
    """Bring the count of cells known by own scans up to date for every drone of a world."""
    for drone in range(layers.shape[0]):
        claim_own(
            air.nodes[world, drone], air.counters[world, drone], air.known[world, drone],
            layers[drone, drone], versions[drone, drone],
        )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def claim_own(node, counters, known, cells, versions):  # type: ignore[no-untyped-def]
    """Count the cells that a drone's scans have made known first; `cells` and `versions` are its own layer.

    Done before peers' evidence comes in, and only for tiles that have changed since the last time.
    """
    newest = node.claimed_clock
    for i in range(versions.shape[0]):
        for j in range(versions.shape[1]):
            version = np.int64(versions[i, j])
            if version > node.claimed_clock:
                newest = max(newest, version)
                counters[OWN_SCAN] += claim_tile(cells, known, i, j)
    node.claimed_clock = newest


@numba.njit(cache=True, nogil=True)
def is_live(peer, tick, rules):  # type: ignore[no-untyped-def]
    """Tell whether a peer (a PEER record) has been heard within the peer timeout."""
    heard = peer.heard_tick
    return heard >= 0 and tick / rules.ticks_per_s - heard / rules.ticks_per_s <= rules.peer_timeout


@numba.njit(cache=True, nogil=True)
def peer_place(peer, tick, rules):  # type: ignore[no-untyped-def]
    """Return (x, y, found): where a peer (a PEER record) is taken to be by its last pose and velocity, while in touch.

    As `MeshNode.teammates`, for leaving returns on teammates out of the map.
    """
    if peer.pose_tick < 0 or not is_live(peer, tick, rules):
        return 0.0, 0.0, False
    ahead = min(max(0.0, (tick - peer.pose_tick) / rules.ticks_per_s), _EXTRAPOLATE_S)
    return peer.x + peer.vx * ahead, peer.y + peer.vy * ahead, True


@numba.njit(cache=True, nogil=True)
def _chance(key, tick, sender, receiver, sequence):  # type: ignore[no-untyped-def]
    """Return a number in [0, 1) of these five alone: three rounds of the finaliser of splitmix64 (Steele 2014)."""
    value = np.uint64(key)
    for part in (np.uint64(tick), np.uint64(sequence), np.uint64(sender * 256 + receiver)):
        value = value + (part + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
        value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        value = value ^ (value >> np.uint64(31))
    return np.float64(value >> np.uint64(11)) / 9007199254740992.0


@numba.njit(cache=True, nogil=True)
def _hear(peer, tick, message):  # type: ignore[no-untyped-def]
    """Note that a peer was heard, and where it says it is."""
    peer.heard_tick = tick
    if message.kind == STATUS:
        peer.hears, peer.vx, peer.vy = message.hears, message.vx, message.vy
    if message.kind == STATUS or message.kind == SCAN:
        peer.pose_tick = tick
        peer.x, peer.y, peer.yaw = message.x, message.y, message.yaw


@numba.njit(cache=True, nogil=True)
def _take_digest(holdings, digest, sender, message):  # type: ignore[no-untyped-def]
    """Note which tiles a peer holds (both `[source, tile]`), of the units that its digest speaks for."""
    tiles = holdings.shape[1]
    units = (tiles + UNIT_TILES - 1) // UNIT_TILES
    for unit in range(message.first_unit, message.last_unit):
        source, first = unit // units, unit % units * UNIT_TILES
        if source != sender:
            for tile in range(first, min(first + UNIT_TILES, tiles)):
                holdings[source, tile] = digest[source, tile]


@numba.njit(cache=True, nogil=True)
def _take_scan(window, marks, counters, known, notes, cells, versions, dirty):  # type: ignore[no-untyped-def]
    """Draw a peer's scan into its layer, except on tiles that already contain it; what it changes turns provisional.

    `cells`, `versions` and `notes` are the receiver's of this sender.
    """
    tile_rows, tile_columns = versions.shape
    radius = marks.shape[0] // 2
    squared = (radius + 1) * (radius + 1)  # a cell's far corner counts, so marks reach a cell further
    fresh = 0
    for block in range(marks.shape[1] // TILE):
        j = window.column // TILE + block
        aside = max(0, j * TILE - window.middle, window.middle - (j * TILE + TILE - 1))
        if j < 0 or j >= tile_columns or aside > radius:
            continue
        half = min(radius, int(math.sqrt(squared - aside * aside)))
        row = max(0, window.row + radius - half)
        last = min(tile_rows * TILE, window.row + radius + half + 1)
        while row < last:
            i = row // TILE
            end = min(last, (i + 1) * TILE)
            if np.int64(versions[i, j]) < window.clock:
                changed, new = draw_marks(
                    cells, known, marks, row, end - row, j * TILE, row - window.row, block * TILE
                )  # fmt: skip
                fresh += new
                if changed:
                    notes[i * tile_columns + j].provisional = 1
                    dirty[i, j] = 1
            row = end
    counters[PEER_SCAN] += fresh


@numba.njit(cache=True, nogil=True)
def _take_tiles(air, world, tick, sender, receiver, message, layers, versions, dirty):  # type: ignore[no-untyped-def]
    """Merge tiles that are newer than what is held, and note that the sender holds them."""
    source, tile_columns, slots = message.source, versions.shape[3], air.tile_cells.shape[2]
    is_own, relays = source == receiver, air.rules.relays
    # passed on by a third while the source is in touch: what was drawn of its scans shows more than the copy
    keeps_drawn = source != sender and not is_own and is_live(air.peers[world, receiver, source], tick, air.rules)
    held_by_sender, notes = air.holdings[world, receiver, sender, source], air.notes[world, receiver, source]
    cells, held, known = layers[receiver, source], versions[receiver, source], air.known[world, receiver]
    fresh = 0
    for k in range(message.count):
        slot = (air.nodes[world, sender].first_tile + k) % slots
        tile, version = air.tile_keys[world, sender, slot, 0], np.uint32(air.tile_keys[world, sender, slot, 1])
        i, j = tile // tile_columns, tile % tile_columns
        note = notes[tile]
        if not is_own and version > held[i, j] and not (keeps_drawn and note.provisional != 0):
            copy_tile(air.tile_cells[world, sender, slot], 0, 0, cells, i * TILE, j * TILE)
            if relays:
                confirmed = air.confirmed[world, receiver, source]
                copy_tile(air.tile_cells[world, sender, slot], 0, 0, confirmed, i * TILE, j * TILE)
            held[i, j] = version
            note.provisional = 0
            dirty[receiver, i, j] = 1
            fresh += claim_tile(cells, known, i, j)
        held_by_sender[tile] = max(held_by_sender[tile], version)
        if not is_own and held[i, j] <= version:
            # those in reach have it from the sender: no need to pass it on at once
            note.sent_version, note.sent_tick = version, tick
    air.counters[world, receiver, PEER_TILE] += fresh
