"""Scans and tiles in the batched air: what each drone shows of its map, as `Speaking` and `TileExchange` do."""

from __future__ import annotations

import numba
import numpy as np

from imagine.core.raster import TILE
from imagine.mesh_comm.information import NO_NEWS_S, known_cells
from imagine.mesh_comm.messages import MAX_DATAGRAM
from imagine.mesh_comm.seal import OVERHEAD
from imagine.sim.air import MOST_DRONES, OWN_SCAN, SCAN, TILES
from imagine.sim.air_costs import packed_tile_bytes, tile_in_message_bytes, tiles_message_bytes
from imagine.sim.air_plan import brings_news, source_and_tile
from imagine.sim.air_tiles import claim, copy_tile
from imagine.sim.air_transmit import can_send, transmit

# these are those of mesh_comm.speaking and tile_exchange
_SCANS_BEFORE_NEWS, _SCANS_BEFORE_REPEATS = 1, 4
_EPSILON_S = 1e-6
_MAX_PAYLOAD = MAX_DATAGRAM - OVERHEAD
_RESERVED_TILE, _RESERVED_TILES = 16, 15
_MOST_TILES = 256


@numba.njit(cache=True, nogil=True)
def is_worth_telling(node, now, rules, clock, cells, versions, known, counters):  # type: ignore[no-untyped-def]
    """Tell whether a scan shows enough that is new, or is long after the last, or stands for one that waits.

    Counts the cells that own scans have made known by now: `cells` and `versions` are the own layer's.
    """
    for i in range(versions.shape[0]):
        for j in range(versions.shape[1]):
            if np.int64(versions[i, j]) > node.claimed_clock:
                counters[OWN_SCAN] += claim(cells, known, i * TILE, TILE, j * TILE)
    node.claimed_clock = np.int64(clock)
    news = counters[OWN_SCAN] - node.told_cells
    if node.pending_clock != 0 or news > 0:
        return True
    return now >= node.next_scan - rules.scan_period + NO_NEWS_S - _EPSILON_S


@numba.njit(cache=True, nogil=True)
def is_tiles_turn(node, head):  # type: ignore[no-untyped-def]
    """Tell whether so many scans went ahead of the queue, whose first entry is `head`, that it has its turn."""
    return node.scans_ahead >= (_SCANS_BEFORE_NEWS if brings_news(head) else _SCANS_BEFORE_REPEATS)


@numba.njit(cache=True, nogil=True)
def send_scan(rules, now, node, messages, counters, windows):  # type: ignore[no-untyped-def]
    """Send the scan that waits; False when bytes run short."""
    if not can_send(node, messages, node.pending_bytes):
        return False
    place = transmit(rules, now, node, messages, counters, SCAN, node.pending_bytes)
    if place >= 0:
        message, window = messages[place], windows[node.pending_slot]
        message.x, message.y, message.yaw, message.slot = window.x, window.y, window.yaw, node.pending_slot
        node.busy_slots |= 1 << node.pending_slot
        node.scans += 1
    node.scan_clock, node.pending_clock, node.pending_slot = node.pending_clock, 0, -1
    node.next_scan, node.pose_told_at = now + rules.scan_period, now
    node.told_cells = counters[OWN_SCAN]
    return True


@numba.njit(cache=True, nogil=True)
def _tile_cost(note, cells, row, column, version, is_sketch):  # type: ignore[no-untyped-def]
    """Return what a tile's cells cost in bytes; of a version that was noted once, as noted, but not of a sketch."""
    if is_sketch:
        return np.int64(packed_tile_bytes(cells, row * TILE, column * TILE))
    if note.cost_version != version:
        note.cost, note.cost_version = packed_tile_bytes(cells, row * TILE, column * TILE), version
    return np.int64(note.cost)


@numba.njit(cache=True, nogil=True)
def send_tiles(air, world, tick, drone, layers, versions):  # type: ignore[no-untyped-def]
    """Send the head of the queue: one datagram of one source's tiles; False when bytes or rings run short."""
    node, wanted = air.nodes[world, drone], air.wanted[world, drone]
    messages, counters = air.messages[world, drone], air.counters[world, drone]
    tile_columns, slots = versions.shape[3], air.tile_cells.shape[2]
    now = tick / air.rules.ticks_per_s
    head, _, _ = source_and_tile(wanted[0])
    source, is_sketch = head % MOST_DRONES, head >= MOST_DRONES
    cells = layers[drone, source] if source == drone or is_sketch else air.confirmed[world, drone, source]
    held, notes = versions[drone, source], air.notes[world, drone, source]
    reserved, size, count = _RESERVED_TILES, 0, 0
    for entry in range(node.wanted):
        its_source, row, column = source_and_tile(wanted[entry])
        if its_source != head:
            continue
        cost = _tile_cost(notes[row * tile_columns + column], cells, row, column, held[row, column], is_sketch)
        reserved += cost + _RESERVED_TILE
        if reserved > _MAX_PAYLOAD or count == _MOST_TILES or node.tiles + count == slots:
            break
        size += tile_in_message_bytes(cost, np.int64(held[row, column]))
        count += 1
    size += tiles_message_bytes(count)
    if count == 0 or not can_send(node, messages, size):
        return False
    place = transmit(air.rules, now, node, messages, counters, TILES, size)
    left = taken = 0
    for entry in range(node.wanted):
        its_source, row, column = source_and_tile(wanted[entry])
        if taken == count or its_source != head:
            wanted[left] = wanted[entry]
            left += 1
            continue
        tile = row * tile_columns + column
        if place >= 0:
            slot = (node.first_tile + node.tiles + taken) % slots
            air.tile_keys[world, drone, slot, 0] = tile
            air.tile_keys[world, drone, slot, 1] = held[row, column]
            copy_tile(cells, row * TILE, column * TILE, air.tile_cells[world, drone, slot], 0, 0)
        taken += 1
        if is_sketch:
            known = known_cells(cells, row * TILE, column * TILE)
            for peer in range(layers.shape[0]):
                if (node.readers >> peer) & 1 == 1:
                    air.sketched[world, drone, peer, source, tile] = known
            continue
        notes[tile].sent_version, notes[tile].sent_tick = held[row, column], tick
        notes[tile].sent_known = known_cells(layers[drone, source], row * TILE, column * TILE)
    node.wanted = left
    if place >= 0:
        messages[place].source, messages[place].count, messages[place].slot = source, count, np.int32(is_sketch)
        node.tiles += count
    return True
