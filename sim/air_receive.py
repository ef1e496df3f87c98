"""The receiving half of the batched air: what has arrived is heard by whom it reaches, and drawn into their maps.

As `RadioMedium.deliver` and `MeshNode.receive`. All arrays but the air's own are those of one world. Small steps take
the arrays they need and not the whole state: handing that on costs more than most of them do.
"""

from __future__ import annotations

import numba
import numpy as np

from imagine.core.raster import TILE
from imagine.mesh_comm.information import known_cells
from imagine.sim.air import (
    BUDGET_DB,
    CLEAR_M,
    DIGEST,
    EXPONENT,
    LOSS,
    OWN_SCAN,
    PEER_SCAN,
    PEER_TILE,
    SCAN,
    STATUS,
    TILES,
    UNIT_TILES,
    WALL_DB,
    WALLED_M,
)
from imagine.sim.air_tiles import claim, copy_tile, draw_marks
from imagine.sim.propagation import Propagation, fill_reach

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
    media = air.media
    loss = media[world, LOSS]
    propagation = Propagation(
        media[world, CLEAR_M], media[world, WALLED_M], media[world, BUDGET_DB], media[world, EXPONENT],
        media[world, WALL_DB],
    )  # fmt: skip
    fill_reach(reach, poses, segments, propagation)
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
            elif loss > 0.0 and _chance(key, tick, sender, receiver, message.sequence) < loss:
                link.lost += 1
                link.lost_bytes += message.size
            else:
                link.delivered += 1
                link.delivered_bytes += message.size
                peer = air.peers[world, receiver, sender]
                if not is_live(peer, tick, rules):
                    _meet(versions[receiver, receiver], air.met[world, receiver, sender])
                _hear(peer, tick, message)
                if message.kind == DIGEST:
                    peer.digest_tick = tick
                    _take_digest(air.holdings[world, receiver, sender], air.digests[world, sender, node.first_digest],
                                 sender, message)  # fmt: skip
                elif rules.shares and (message.kind == SCAN or message.kind == TILES):
                    if message.kind == SCAN:
                        _take_scan(
                            air.windows[world, sender, message.slot], air.marks[world, sender, message.slot],
                            air.spans[world, sender, message.slot], air.counters[world, receiver],
                            air.known[world, receiver], air.notes[world, receiver, sender], layers[receiver, receiver],
                            layers[receiver, sender], versions[receiver, sender], dirty[receiver],
                        )  # fmt: skip
                    elif message.slot == 1:
                        if not is_live(air.peers[world, receiver, message.source], tick, rules):
                            _take_sketch(
                                air, world, sender, message, layers[receiver, receiver], air.known[world, receiver],
                                air.counters[world, receiver], layers[receiver, message.source],
                                versions[receiver, message.source], air.notes[world, receiver, message.source],
                                dirty[receiver], receiver,
                            )  # fmt: skip
                    elif message.source == sender or message.source == receiver or rules.relays:
                        _take_tiles(air, world, tick, sender, receiver, message, layers, versions, dirty)
        if message.kind == SCAN:
            node.busy_slots &= ~(1 << message.slot)
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
def claim_own(air, world, layers):  # type: ignore[no-untyped-def]
    """Bring the count of cells known by own scans up to date for every drone of a world; before it is read."""
    for drone in range(layers.shape[0]):
        for i in range(layers.shape[2] // TILE):
            for j in range(layers.shape[3] // TILE):
                own = claim(layers[drone, drone], air.known[world, drone], i * TILE, TILE, j * TILE)
                air.counters[world, drone, OWN_SCAN] += own


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
def _meet(versions, met):  # type: ignore[no-untyped-def]
    """Note the own tile versions, `[tile rows, tile columns]`, that a peer finds when it comes into reach."""
    for row in range(versions.shape[0]):
        for column in range(versions.shape[1]):
            met[row * versions.shape[1] + column] = versions[row, column]


@numba.njit(cache=True, nogil=True)
def _hear(peer, tick, message):  # type: ignore[no-untyped-def]
    """Note that a peer was heard, and where it says it is."""
    peer.heard_tick = tick
    if message.kind == STATUS:
        peer.vx, peer.vy = message.vx, message.vy
        if message.slot == 0:  # not of the pose alone
            peer.status_tick, peer.hears = tick, message.hears
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
def _take_scan(window, marks, spans, counters, known, notes, own_cells, cells, versions, dirty):  # type: ignore[no-untyped-def]
    """Draw a peer's scan into its layer, except on tiles that already contain it; what it changes turns provisional.

    `cells`, `versions` and `notes` are the receiver's of this sender, `own_cells` its own layer. Where cells get their
    first evidence, what own scans have made known by now is counted before it.
    """
    tile_rows, tile_columns = versions.shape
    for block in range(spans.shape[0]):
        j = window.column // TILE + block
        if j < 0 or j >= tile_columns:
            continue
        row = max(0, window.row + spans[block, 0])
        last = min(tile_rows * TILE, window.row + spans[block, 1])
        while row < last:
            i = row // TILE
            end = min(last, (i + 1) * TILE)
            if np.int64(versions[i, j]) < window.clock:
                mark_row, mark_column = row - window.row, block * TILE
                changed, first = draw_marks(cells, marks, row, end - row, j * TILE, mark_row, mark_column)
                if first > 0:
                    counters[OWN_SCAN] += claim(own_cells, known, row, end - row, j * TILE)
                    counters[PEER_SCAN] += claim(cells, known, row, end - row, j * TILE)
                if changed > 0:
                    notes[i * tile_columns + j].provisional = 1
                    dirty[i, j] = 1
            row = end


@numba.njit(cache=True, nogil=True)
def _take_sketch(air, world, sender, message, own_cells, known, counters, cells, versions, notes, dirty, receiver):  # type: ignore[no-untyped-def]
    """Fill in cells without evidence from tiles that a third drew scans of the source on, as `EvidenceMap.sketch_tile`.

    `cells`, `versions` and `notes` are the receiver's of the source.
    """
    if message.source == receiver:
        return
    tile_columns, slots = versions.shape[1], air.tile_cells.shape[2]
    for k in range(message.count):
        slot = (air.nodes[world, sender].first_tile + k) % slots
        tile, version = air.tile_keys[world, sender, slot, 0], np.uint32(air.tile_keys[world, sender, slot, 1])
        i, j = tile // tile_columns, tile % tile_columns
        if version < versions[i, j]:
            continue
        copy, filled = air.tile_cells[world, sender, slot], False
        for row in range(TILE):
            for column in range(TILE):
                value, y, x = copy[row, column], i * TILE + row, j * TILE + column
                if value != 0 and cells[y, x] == 0:
                    cells[y, x] = value
                    filled = True
        if filled:
            counters[OWN_SCAN] += claim(own_cells, known, i * TILE, TILE, j * TILE)
            counters[PEER_SCAN] += claim(cells, known, i * TILE, TILE, j * TILE)
            notes[tile].provisional = 1
            dirty[i, j] = 1


@numba.njit(cache=True, nogil=True)
def _take_tiles(air, world, tick, sender, receiver, message, layers, versions, dirty):  # type: ignore[no-untyped-def]
    """Merge tiles that are newer than what is held, and note that the sender holds them."""
    source, tile_columns, slots = message.source, versions.shape[3], air.tile_cells.shape[2]
    is_own, relays = source == receiver, air.rules.relays
    # passed on by a third while the source is in touch: what was drawn of its scans shows more than the copy
    keeps_drawn = source != sender and not is_own and is_live(air.peers[world, receiver, source], tick, air.rules)
    held_by_sender, notes = air.holdings[world, receiver, sender, source], air.notes[world, receiver, source]
    cells, held, known = layers[receiver, source], versions[receiver, source], air.known[world, receiver]
    own_cells, counters = layers[receiver, receiver], air.counters[world, receiver]
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
            counters[OWN_SCAN] += claim(own_cells, known, i * TILE, TILE, j * TILE)
            counters[PEER_TILE] += claim(cells, known, i * TILE, TILE, j * TILE)
        held_by_sender[tile] = max(held_by_sender[tile], version)
        if not is_own and held[i, j] <= version:
            # those in reach have it from the sender: no need to pass it on at once
            note.sent_version, note.sent_tick = version, tick
            note.sent_known = known_cells(cells, i * TILE, j * TILE)
