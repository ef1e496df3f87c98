"""The receiving half of the batched air: what has arrived is heard by whom it reaches, and drawn into their maps.

As `RadioMedium.deliver` and `MeshNode.receive`. All arrays but the air's own are those of one world.
"""

from __future__ import annotations

import numba
import numpy as np

from imagine.core.raster import LIMIT, TILE
from imagine.sim.air import DIGEST, OWN_SCAN, PEER_SCAN, PEER_TILE, SCAN, STATUS, TILES, UNIT_TILES
from imagine.sim.propagation import fill_reach

_LOWEST, _HIGHEST = np.int8(-LIMIT), np.int8(LIMIT)
_EXTRAPOLATE_S = 1.0  # as in mesh_comm.peers


@numba.njit(cache=True, nogil=True)
def deliver(air, world, tick, key, poses, segments, layers, versions, dirty):  # type: ignore[no-untyped-def]
    """Deliver what has arrived in `world` by `tick` to all who hear it at `poses` (`[drones, 2 or more]`, metres).

    `segments` `[n, 4]` are the faces of the walls; `key` (uint64) draws the losses, so that a world does not depend on
    what else runs. Writes peers' evidence into `layers` (int8 `[holder, source, rows, columns]`) and `versions`
    (uint32 `[holder, source, tile rows, tile columns]`), and sets `dirty` (uint8 `[holder, tile rows, tile columns]`)
    where a holder's belief may have changed. Messages come by arrival, then sender, then order of sending.
    """
    rules = air.rules
    drones = layers.shape[0]
    reach = air.reach[world]
    links = air.links[world]
    nodes = air.nodes[world]
    fill_reach(reach, poses, segments, rules.propagation)
    for sender in range(drones):
        for receiver in range(drones):
            links[sender, receiver].ticks += reach[sender, receiver]
    now = tick / rules.ticks_per_s
    while True:
        sender, earliest = -1, now + 1e-9
        for other in range(drones):
            if nodes[other].messages > 0:
                arrival = air.messages[world, other, nodes[other].first_message].arrival
                if arrival < earliest or (arrival == earliest and sender < 0):
                    sender, earliest = other, arrival
        if sender < 0:
            return
        message = air.messages[world, sender, nodes[sender].first_message]
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
                _hear(air, world, tick, sender, receiver, message)
                if message.kind == SCAN and rules.shares:
                    _take_scan(air, world, sender, receiver, layers, versions, dirty)
                elif message.kind == TILES and rules.shares:
                    _take_tiles(air, world, tick, sender, receiver, message, layers, versions, dirty)
                elif message.kind == DIGEST:
                    _take_digest(air, world, tick, sender, receiver, message)
        _drop_first(air, nodes[sender], message)


@numba.njit(cache=True, nogil=True, inline="always")
def claim_own(air, world, drone, cells, versions):  # type: ignore[no-untyped-def]
    """Count the cells that own scans have made known first; `cells` and `versions` are the drone's own layer.

    Done before peers' evidence comes in, and only for tiles that changed since. Call it before reading `cells_known`.
    """
    node = air.nodes[world, drone]
    newest = node.claimed_clock
    for i in range(versions.shape[0]):
        for j in range(versions.shape[1]):
            if versions[i, j] > node.claimed_clock:
                newest = max(newest, np.int64(versions[i, j]))
                air.cells_known[world, drone, OWN_SCAN] += _claim_tile(cells, air.known[world, drone], i, j)
    node.claimed_clock = newest


@numba.njit(cache=True, nogil=True)
def peer_place(air, world, tick, drone, peer):  # type: ignore[no-untyped-def]
    """Return (x, y, known): where `drone` takes `peer` to be by its last pose and velocity, while it is in touch.

    As `MeshNode.teammates`, for leaving returns on teammates out of the map.
    """
    rate = air.rules.ticks_per_s
    if not is_live(air, world, tick, drone, peer) or air.peer_pose_tick[world, drone, peer] < 0:
        return 0.0, 0.0, False
    ahead = min(max(0.0, (tick - air.peer_pose_tick[world, drone, peer]) / rate), _EXTRAPOLATE_S)
    pose, velocity = air.peer_pose[world, drone, peer], air.peer_velocity[world, drone, peer]
    return pose[0] + velocity[0] * ahead, pose[1] + velocity[1] * ahead, True


@numba.njit(cache=True, nogil=True, inline="always")
def is_live(air, world, tick, drone, peer):  # type: ignore[no-untyped-def]
    """Tell whether `drone` has heard `peer` within the peer timeout."""
    heard = air.heard_tick[world, drone, peer]
    rate = air.rules.ticks_per_s
    return heard >= 0 and tick / rate - heard / rate <= air.rules.peer_timeout


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


@numba.njit(cache=True, nogil=True, inline="always")
def _hear(air, world, tick, sender, receiver, message):  # type: ignore[no-untyped-def]
    """Note that a peer was heard, and where it says it is."""
    air.heard_tick[world, receiver, sender] = tick
    if message.kind == STATUS:
        air.peer_hears[world, receiver, sender] = message.hears
        air.peer_velocity[world, receiver, sender, 0] = message.vx
        air.peer_velocity[world, receiver, sender, 1] = message.vy
    if message.kind == STATUS or message.kind == SCAN:
        air.peer_pose_tick[world, receiver, sender] = tick
        pose = air.peer_pose[world, receiver, sender]
        pose[0], pose[1], pose[2] = message.x, message.y, message.yaw


@numba.njit(cache=True, nogil=True, inline="always")
def _take_digest(air, world, tick, sender, receiver, message):  # type: ignore[no-untyped-def]
    """Note which tiles a peer holds, of the units that its digest speaks for."""
    sources, tiles = air.holdings.shape[3], air.holdings.shape[4]
    units = (tiles + UNIT_TILES - 1) // UNIT_TILES
    held = air.digest_versions[world, sender, air.nodes[world, sender].first_digest]
    for unit in range(message.first_unit, message.last_unit):
        source, first = unit // units, unit % units * UNIT_TILES
        if source == sender or source >= sources:
            continue
        for tile in range(first, min(first + UNIT_TILES, tiles)):
            air.holdings[world, receiver, sender, source, tile] = held[source, tile]
    air.digest_tick[world, receiver, sender] = tick


@numba.njit(cache=True, nogil=True, inline="always")
def _take_scan(air, world, sender, receiver, layers, versions, dirty):  # type: ignore[no-untyped-def]
    """Draw a peer's scan, except on tiles that already contain it; the tiles it changes turn provisional."""
    slot = air.nodes[world, sender].first_scan
    window = air.scan_windows[world, sender, slot]
    marks, spans = air.scan_marks[world, sender, slot], air.scan_spans[world, sender, slot]
    known, cells = air.known[world, receiver], layers[receiver, sender]
    claim_own(air, world, receiver, layers[receiver, receiver], versions[receiver, receiver])
    fresh = 0
    for block in range(window.blocks):
        j = window.column // TILE + block
        low, high = window.row + spans[block, 0], window.row + spans[block, 1]
        row = low
        while row < high:
            i = row // TILE
            end = min(high, (i + 1) * TILE)
            if versions[receiver, sender, i, j] < window.clock:
                changed, new = _draw(cells, known, marks, row, end - row, j * TILE, row - window.row, block * TILE)
                fresh += new
                if changed:
                    air.provisional[world, receiver, sender, i * versions.shape[3] + j] = 1
                    dirty[receiver, i, j] = 1
            row = end
    air.cells_known[world, receiver, PEER_SCAN] += fresh


@numba.njit(cache=True, nogil=True)
def _draw(cells, known, marks, row0, rows, column0, mark_row0, mark_column0):  # type: ignore[no-untyped-def]
    """Add marks to one tile's width of cells; return whether any changed, and how many are known for the first time.

    All in 8 bits and without branches, so that a row of a tile is one vector. A cell is known for the first time when
    it is first marked: until then no source has evidence of it.
    """
    changed = np.int8(0)
    fresh = 0
    for i in range(rows):
        row, mark_row = np.uintp(row0 + i), np.uintp(mark_row0 + i)
        row_fresh = np.int8(0)
        for k in range(TILE):
            column = np.uintp(column0 + k)
            mark = marks[mark_row, np.uintp(mark_column0 + k)]
            old, was_known = cells[row, column], known[row, column]
            new = np.int8(max(np.int8(min(np.int8(old + mark), _HIGHEST)), _LOWEST))
            marked = np.int8(mark != 0)
            changed = np.int8(changed | np.int8(new ^ old))
            row_fresh = np.int8(row_fresh + np.int8(marked & ~was_known))
            cells[row, column] = new
            known[row, column] = np.int8(was_known | marked)
        fresh += row_fresh
    return changed != 0, fresh


@numba.njit(cache=True, nogil=True, inline="always")
def _take_tiles(air, world, tick, sender, receiver, message, layers, versions, dirty):  # type: ignore[no-untyped-def]
    """Merge tiles that are newer than what is held, and note that the sender holds them."""
    source, tile_columns = message.source, versions.shape[3]
    if source != receiver and source != sender and not air.rules.relays:
        return
    # passed on by a third while the source is in touch: what was drawn of its scans shows more than the copy
    keep_drawn = source != sender and source != receiver and is_live(air, world, tick, receiver, source)
    if source != receiver:
        claim_own(air, world, receiver, layers[receiver, receiver], versions[receiver, receiver])
    slots = air.tile_cells.shape[2]
    for k in range(message.count):
        slot = (air.nodes[world, sender].first_tile + k) % slots
        tile, version = air.tile_keys[world, sender, slot, 0], np.uint32(air.tile_keys[world, sender, slot, 1])
        i, j = tile // tile_columns, tile % tile_columns
        is_newer = source != receiver and version > versions[receiver, source, i, j]
        if is_newer and not (keep_drawn and air.provisional[world, receiver, source, tile] != 0):
            cells = air.tile_cells[world, sender, slot]
            copy_tile(cells, 0, 0, layers[receiver, source], i * TILE, j * TILE)
            if air.rules.relays:
                copy_tile(cells, 0, 0, air.confirmed[world, receiver, source], i * TILE, j * TILE)
            versions[receiver, source, i, j] = version
            air.provisional[world, receiver, source, tile] = 0
            dirty[receiver, i, j] = 1
            known = _claim_tile(layers[receiver, source], air.known[world, receiver], i, j)
            air.cells_known[world, receiver, PEER_TILE] += known
        held = air.holdings[world, receiver, sender, source, tile]
        air.holdings[world, receiver, sender, source, tile] = max(held, version)
        if source != receiver and versions[receiver, source, i, j] <= version:
            # those in reach have it from the sender: no need to pass it on at once
            air.sent_version[world, receiver, source, tile] = version
            air.sent_tick[world, receiver, source, tile] = tick


@numba.njit(cache=True, nogil=True)
def _claim_tile(cells, known, i, j):  # type: ignore[no-untyped-def]
    """Mark the cells with evidence in tile (i, j) of a layer as known; return how many were not before."""
    fresh = 0
    for k in range(TILE):
        row = np.uintp(i * TILE + k)
        row_fresh = np.int8(0)
        for m in range(TILE):
            column = np.uintp(j * TILE + m)
            has_evidence, was_known = np.int8(cells[row, column] != 0), known[row, column]
            row_fresh = np.int8(row_fresh + np.int8(has_evidence & ~was_known))
            known[row, column] = np.int8(was_known | has_evidence)
        fresh += row_fresh
    return fresh


@numba.njit(cache=True, nogil=True)
def copy_tile(source, row0, column0, target, target_row0, target_column0):  # type: ignore[no-untyped-def]
    """Copy a tile of cells from one place to another."""
    for k in range(TILE):
        row, target_row = np.uintp(row0 + k), np.uintp(target_row0 + k)
        for m in range(TILE):
            target[target_row, np.uintp(target_column0 + m)] = source[row, np.uintp(column0 + m)]


@numba.njit(cache=True, nogil=True, inline="always")
def _drop_first(air, node, message):  # type: ignore[no-untyped-def]
    """Take the sender's oldest message and its content out of the rings."""
    if message.kind == SCAN:
        node.first_scan = (node.first_scan + 1) % air.scan_windows.shape[2]
        node.scans -= 1
    elif message.kind == TILES:
        node.first_tile = (node.first_tile + message.count) % air.tile_cells.shape[2]
        node.tiles -= message.count
    elif message.kind == DIGEST:
        node.first_digest = (node.first_digest + 1) % air.digest_versions.shape[2]
        node.digests -= 1
    node.first_message = (node.first_message + 1) % air.messages.shape[2]
    node.messages -= 1
