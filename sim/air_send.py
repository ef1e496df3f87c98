"""The sending half of the batched air: what each drone puts on air, in which order, within its budget of bytes.

As `MeshNode.offer_scan` and `poll`, `TileExchange.plan` and `RadioMedium.send`. All arrays but the air's own are those
of one world.
"""

from __future__ import annotations

import numba
import numpy as np

from imagine.core.raster import TILE
from imagine.mesh_comm.messages import MAX_DATAGRAM
from imagine.mesh_comm.seal import OVERHEAD
from imagine.sim.air import DIGEST, MOST_WANTED, NEVER, SCAN, STATUS, TILES, UNIT_TILES
from imagine.sim.air_costs import (
    digest_message_bytes,
    packed_tile_bytes,
    packed_versions_bytes,
    scan_bytes,
    status_bytes,
    tile_in_message_bytes,
    tiles_message_bytes,
)
from imagine.sim.air_receive import copy_tile, is_live

# these are those of mesh_comm.node, tile_exchange and digest
_PLAN_PERIOD_S = 0.2
_DIGEST_DATAGRAMS = 4
_DIGEST_GRACE_S = 0.25
_EPSILON_S = 1e-6
_MAX_PAYLOAD = MAX_DATAGRAM - OVERHEAD
_RESERVED_TILE, _RESERVED_TILES = 16, 10
_RESERVED_HOLDING, _RESERVED_DIGEST = 24, 24
_MOST_TILES = 256

_PLACES, _SOURCES, _STALE, _MISSING = 1 << 24, 1 << 6, 1 << 24, 1 << 6


@numba.njit(cache=True, nogil=True)
def send(air, world, tick, poses, velocity, ranges, marks, mark_corner, clocks, layers, versions):  # type: ignore[no-untyped-def]
    """Let every drone of `world` say at `tick` what it has to say; call it when own scans have been integrated.

    `poses` `[drones, 3]` and `velocity` `[drones, 2 or more]` in the map frame; `ranges` float32 `[drones, beams]` as
    they were mapped; `marks` int8 `[drones, n, m]` the evidence of each drone's scan, its first cell at `mark_corner`
    (`[drones, 2]`: row and column of the grid, negative where it starts outside); `clocks` `[drones]` the own layers'
    clocks. `layers` and `versions` as in `deliver`.
    """
    rules = air.rules
    now = tick / rules.ticks_per_s
    for drone in range(layers.shape[0]):
        node = air.nodes[world, drone]
        node.tokens = min(rules.burst, node.tokens + rules.budget_rate / rules.ticks_per_s)
        has_listeners = False
        if rules.shares:
            for peer in range(layers.shape[0]):
                has_listeners = has_listeners or (peer != drone and is_live(air, world, tick, drone, peer))
        if has_listeners:
            _offer_scan(air, world, now, drone, poses, ranges, marks, mark_corner, clocks, versions)
        if has_listeners and now >= node.next_digest - _EPSILON_S:
            node.next_digest = now + rules.digest_period
            tiles = versions.shape[2] * versions.shape[3]
            node.digest_units = versions.shape[1] * ((tiles + UNIT_TILES - 1) // UNIT_TILES)
            node.digest_parts = _DIGEST_DATAGRAMS
        if now >= node.next_plan - _EPSILON_S:
            node.next_plan = now + _PLAN_PERIOD_S
            node.wanted = 0
            if has_listeners:
                _plan(air, world, tick, drone, versions)
        if not _send_status(air, world, tick, drone, poses, velocity):
            continue
        if not _send_digests(air, world, now, drone, versions):
            continue
        # scans must not starve tiles: whichever of the two went short of bytes goes first the next time
        if node.tiles_first:
            if _send_tiles(air, world, tick, drone, layers, versions):
                node.tiles_first = False
                _send_scan(air, world, now, drone)
        elif _send_scan(air, world, now, drone):
            node.tiles_first = not _send_tiles(air, world, tick, drone, layers, versions)


@numba.njit(cache=True, nogil=True, inline="always")
def _can_send(air, world, drone, size):  # type: ignore[no-untyped-def]
    """Tell whether the byte budget and the ring of messages have room."""
    node = air.nodes[world, drone]
    return size <= node.tokens and node.messages < air.messages.shape[2]


@numba.njit(cache=True, nogil=True, inline="always")
def _transmit(air, world, now, drone, kind, size):  # type: ignore[no-untyped-def]
    """Spend the bytes and put a message behind the sender's others on air; return its place in the ring, or -1.

    The radio drops what its queue does not hold, as `RadioMedium.send`; the node does not know, and has paid.
    """
    rules, node = air.rules, air.nodes[world, drone]
    node.tokens -= size
    air.bytes_sent[world, drone, kind] += size
    air.messages_sent[world, drone, kind] += 1
    start = max(now, node.busy_until)
    if (start - now) * rules.air_rate + size > rules.queue_bytes:
        node.dropped += 1
        return -1
    place = (node.first_message + node.messages) % air.messages.shape[2]
    message = air.messages[world, drone, place]
    node.busy_until = start + size / rules.air_rate
    message.arrival = node.busy_until + rules.latency
    message.kind, message.size, message.sequence = kind, size, node.sequence
    node.sequence += 1
    node.messages += 1
    return place


@numba.njit(cache=True, nogil=True, inline="always")
def _send_status(air, world, tick, drone, poses, velocity):  # type: ignore[no-untyped-def]
    rules, node = air.rules, air.nodes[world, drone]
    now = tick / rules.ticks_per_s
    if now < node.next_status - _EPSILON_S:
        return True
    drones, heard, hears = air.heard_tick.shape[1], 0, 0
    for peer in range(drones):
        if air.heard_tick[world, drone, peer] >= 0:
            heard += 1
            if is_live(air, world, tick, drone, peer):
                hears |= 1 << peer
    size = status_bytes(air.cells_known[world, drone], air.bytes_sent[world, drone], heard)
    if not _can_send(air, world, drone, size):
        return False
    place = _transmit(air, world, now, drone, STATUS, size)
    if place >= 0:
        message = air.messages[world, drone, place]
        message.x, message.y, message.yaw = poses[drone, 0], poses[drone, 1], poses[drone, 2]
        message.vx, message.vy, message.hears = velocity[drone, 0], velocity[drone, 1], hears
    node.next_status = now + rules.status_period
    return True


@numba.njit(cache=True, nogil=True, inline="always")
def _send_digests(air, world, now, drone, versions):  # type: ignore[no-untyped-def]
    """Tell which tiles of others are held, in as many datagrams as that takes; a long digest goes on the next time."""
    node = air.nodes[world, drone]
    tile_columns = versions.shape[3]
    tiles = versions.shape[2] * tile_columns
    units = (tiles + UNIT_TILES - 1) // UNIT_TILES
    while node.digest_units > 0 and node.digest_parts > 0:
        first = node.digest_unit
        last, reserved, holdings, packed = first, _RESERVED_DIGEST, 0, 0
        while last < versions.shape[1] * units and last - first < node.digest_units:
            source, begin, held = last // units, last % units * UNIT_TILES, 0
            if source != drone:
                for tile in range(begin, min(begin + UNIT_TILES, tiles)):
                    held += versions[drone, source, tile // tile_columns, tile % tile_columns] > 0
            if held > 0:
                size = packed_versions_bytes(held)
                if reserved + size + _RESERVED_HOLDING > _MAX_PAYLOAD and holdings > 0:
                    break
                reserved += size + _RESERVED_HOLDING
                holdings += 1
                packed += size
            last += 1
        size = digest_message_bytes(holdings, packed)
        slots = air.digest_versions.shape[2]
        if node.digests == slots or not _can_send(air, world, drone, size):
            return False
        place = _transmit(air, world, now, drone, DIGEST, size)
        if place >= 0:
            message = air.messages[world, drone, place]
            message.first_unit, message.last_unit = first, last
            copy = air.digest_versions[world, drone, (node.first_digest + node.digests) % slots]
            for source in range(first // units, (last - 1) // units + 1):
                for tile in range(tiles):
                    copy[source, tile] = versions[drone, source, tile // tile_columns, tile % tile_columns]
            node.digests += 1
        node.digest_units -= last - first
        node.digest_parts -= 1
        node.digest_unit = last % (versions.shape[1] * units)
    return True


@numba.njit(cache=True, nogil=True, inline="always")
def _offer_scan(air, world, now, drone, poses, ranges, marks, mark_corner, clocks, versions):  # type: ignore[no-untyped-def]
    """Keep the marks of a scan that changed the map, for sending; it replaces one that still waits."""
    rules, node = air.rules, air.nodes[world, drone]
    slots = air.scan_windows.shape[2]
    if now < node.next_scan - _EPSILON_S or clocks[drone] == node.scan_clock or node.scans == slots:
        return
    slot = (node.first_scan + node.scans) % slots
    window = air.scan_windows[world, drone, slot]
    _keep_marks(
        window, air.scan_spans[world, drone, slot], air.scan_marks[world, drone, slot], marks[drone],
        mark_corner[drone, 0], mark_corner[drone, 1], versions.shape[2] * TILE, versions.shape[3] * TILE,
    )  # fmt: skip
    window.clock = clocks[drone]
    window.x, window.y, window.yaw = poses[drone, 0], poses[drone, 1], poses[drone, 2]
    node.pending_clock = clocks[drone]
    node.pending_bytes = scan_bytes(ranges[drone], rules.range_min, rules.range_cap, node.pending_clock)


@numba.njit(cache=True, nogil=True)
def _keep_marks(window, spans, kept, marks, corner_row, corner_column, rows, columns):  # type: ignore[no-untyped-def]
    """Copy marks to `kept` in whole tiles' widths, and what lies off the grid not; `spans` tells each width's rows."""
    first_row, last_row = max(0, corner_row), min(rows, corner_row + marks.shape[0])
    first_column, last_column = max(0, corner_column), min(columns, corner_column + marks.shape[1])
    window.row, window.column = first_row, first_column // TILE * TILE
    window.rows = max(0, last_row - first_row)
    window.blocks = max(0, (last_column - window.column + TILE - 1) // TILE)
    for block in range(window.blocks):
        column = window.column + block * TILE
        begin, end = max(first_column, column), min(last_column, column + TILE)
        low, high = 0, 0
        for i in range(window.rows):
            row, mark_row = np.uintp(i), np.uintp(first_row + i - corner_row)
            seen = np.int8(0)
            if end - begin == TILE:  # a length known to the compiler is one vector
                for k in range(TILE):
                    mark = marks[mark_row, np.uintp(begin - corner_column + k)]
                    kept[row, np.uintp(block * TILE + k)] = mark
                    seen = np.int8(seen | mark)
            else:
                for k in range(TILE):
                    kept[row, np.uintp(block * TILE + k)] = 0
                for k in range(end - begin):
                    mark = marks[mark_row, np.uintp(begin - corner_column + k)]
                    kept[row, np.uintp(begin - window.column + k)] = mark
                    seen = np.int8(seen | mark)
            if seen != 0:
                if high == 0:
                    low = i
                high = i + 1
        spans[block, 0], spans[block, 1] = low, high


@numba.njit(cache=True, nogil=True, inline="always")
def _send_scan(air, world, now, drone):  # type: ignore[no-untyped-def]
    node = air.nodes[world, drone]
    if node.pending_clock == 0:
        return True
    if not _can_send(air, world, drone, node.pending_bytes):
        return False
    place = _transmit(air, world, now, drone, SCAN, node.pending_bytes)
    if place >= 0:
        message = air.messages[world, drone, place]
        window = air.scan_windows[world, drone, (node.first_scan + node.scans) % air.scan_windows.shape[2]]
        message.x, message.y, message.yaw, message.clock = window.x, window.y, window.yaw, window.clock
        node.scans += 1
    node.scan_clock, node.pending_clock = node.pending_clock, 0
    node.next_scan = now + air.rules.scan_period
    return True


@numba.njit(cache=True, nogil=True, inline="always")
def _plan(air, world, tick, drone, versions):  # type: ignore[no-untyped-def]
    """Queue the tiles that some peer in touch, by its last digest, lacks: most lacking first, then most outdated.

    A queue entry is its rank and place in one number, least first.
    """
    rules, node = air.rules, air.nodes[world, drone]
    rate, drones, tile_columns = rules.ticks_per_s, versions.shape[1], versions.shape[3]
    now = tick / rate
    wanted = air.wanted[world, drone]
    for source in range(drones):
        if source != drone and not rules.relays:
            continue
        for tile in range(versions.shape[2] * tile_columns):
            row, column = tile // tile_columns, tile % tile_columns
            version = np.int64(versions[drone, source, row, column])
            if version == 0:
                continue
            sent_tick = air.sent_tick[world, drone, source, tile]
            sent_at, was_sent = sent_tick / rate, sent_tick > NEVER
            if was_sent and now - sent_at < rules.tile_period:
                continue
            sent_version = np.int64(air.sent_version[world, drone, source, tile])
            missing, stale = 0, 0
            for peer in range(drones):
                told_tick = air.digest_tick[world, drone, peer]
                if peer in (source, drone) or told_tick < 0 or not is_live(air, world, tick, drone, peer):
                    continue
                held = np.int64(air.holdings[world, drone, peer, source, tile])
                if held >= version:
                    continue
                if was_sent and sent_version >= version and told_tick / rate < sent_at + _DIGEST_GRACE_S:
                    continue  # sent since this peer last told what it holds
                if source != drone and _serves_itself(air, world, tick, drone, source, peer):
                    continue
                missing += held == 0
                stale += version - held
            if stale > 0:
                rank = (_MISSING - 1 - missing) * _STALE + max(0, _STALE - 1 - stale)
                place = column * 4096 + row  # ties in the order of tile keys
                wanted[node.wanted] = ((rank * 2 + (source != drone)) * _SOURCES + source) * _PLACES + place
                node.wanted += 1
    _sort(wanted, node.wanted)
    node.wanted = min(node.wanted, MOST_WANTED)


@numba.njit(cache=True, nogil=True, inline="always")
def _serves_itself(air, world, tick, drone, source, peer):  # type: ignore[no-untyped-def]
    """Tell whether source and peer, both in touch, hear each other, so that the source sends the peer its tiles."""
    if air.digest_tick[world, drone, source] < 0 or not is_live(air, world, tick, drone, source):
        return False
    hears = air.peer_hears[world, drone]
    return (hears[peer] >> source) & 1 == 1 and (hears[source] >> peer) & 1 == 1


@numba.njit(cache=True, nogil=True)
def _sort(values, count):  # type: ignore[no-untyped-def]
    """Sort the first `count` values, in place: a Shell sort with Knuth's gaps (1973), for it needs no memory."""
    gap = 1
    while gap < count // 3:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(gap, count):
            value, j = values[i], i
            while j >= gap and values[j - gap] > value:
                values[j] = values[j - gap]
                j -= gap
            values[j] = value
        gap //= 3


@numba.njit(cache=True, nogil=True, inline="always")
def _send_tiles(air, world, tick, drone, layers, versions):  # type: ignore[no-untyped-def]
    """Send the queue, a datagram of one source's tiles at a time; False when bytes or rings run short."""
    node = air.nodes[world, drone]
    wanted = air.wanted[world, drone]
    tile_columns, slots = versions.shape[3], air.tile_cells.shape[2]
    now = tick / air.rules.ticks_per_s
    while node.wanted > 0:
        source = wanted[0] // _PLACES % _SOURCES
        reserved, size, count = _RESERVED_TILES, 0, 0
        for entry in range(node.wanted):
            if wanted[entry] // _PLACES % _SOURCES != source:
                continue
            row, column = wanted[entry] % 4096, wanted[entry] % _PLACES // 4096
            packed = _packed_bytes(air, world, drone, source, row, column, layers, versions)
            reserved += packed + _RESERVED_TILE
            if reserved > _MAX_PAYLOAD or count == _MOST_TILES or node.tiles + count == slots:
                break
            size += tile_in_message_bytes(packed, np.int64(versions[drone, source, row, column]))
            count += 1
        size += tiles_message_bytes(count)
        if count == 0 or not _can_send(air, world, drone, size):
            return False
        place = _transmit(air, world, now, drone, TILES, size)
        left = taken = 0
        for entry in range(node.wanted):
            if taken == count or wanted[entry] // _PLACES % _SOURCES != source:
                wanted[left] = wanted[entry]
                left += 1
                continue
            row, column = wanted[entry] % 4096, wanted[entry] % _PLACES // 4096
            tile, version = row * tile_columns + column, versions[drone, source, row, column]
            if place >= 0:
                slot = (node.first_tile + node.tiles + taken) % slots
                air.tile_keys[world, drone, slot, 0], air.tile_keys[world, drone, slot, 1] = tile, version
                copy = air.tile_cells[world, drone, slot]
                if source == drone:
                    copy_tile(layers[drone, source], row * TILE, column * TILE, copy, 0, 0)
                else:
                    copy_tile(air.confirmed[world, drone, source], row * TILE, column * TILE, copy, 0, 0)
            air.sent_version[world, drone, source, tile] = version
            air.sent_tick[world, drone, source, tile] = tick
            taken += 1
        node.wanted = left
        if place >= 0:
            message = air.messages[world, drone, place]
            message.source, message.count = source, count
            node.tiles += count
    return True


@numba.njit(cache=True, nogil=True, inline="always")
def _packed_bytes(air, world, drone, source, row, column, layers, versions):  # type: ignore[no-untyped-def]
    """Return the estimated bytes of a tile's cells, counted once for each version."""
    tile, version = row * versions.shape[3] + column, versions[drone, source, row, column]
    if air.cost_version[world, drone, source, tile] != version:
        cells = layers[drone, source] if source == drone else air.confirmed[world, drone, source]
        air.cost[world, drone, source, tile] = packed_tile_bytes(cells, row * TILE, column * TILE)
        air.cost_version[world, drone, source, tile] = version
    return np.int64(air.cost[world, drone, source, tile])
