"""The sending half of the batched air: what each drone puts on air, in which order, within its budget of bytes.

As `MeshNode.offer_scan` and `poll`, `TileExchange.plan` and `RadioMedium.send`. All arrays but the air's own are those
of one world.
"""

from __future__ import annotations

import numba
import numpy as np

from imagine.core.raster import TILE
from imagine.mesh_comm.information import NO_NEWS_S, known_cells
from imagine.mesh_comm.messages import MAX_DATAGRAM
from imagine.mesh_comm.seal import OVERHEAD
from imagine.sim.air import (
    BUDGET,
    BYTES_SENT,
    DIGEST,
    MESSAGES_SENT,
    MOST_DRONES,
    OWN_SCAN,
    SCAN,
    STATUS,
    TILES,
    UNIT_TILES,
)
from imagine.sim.air_costs import (
    digest_message_bytes,
    here_bytes,
    packed_ranges_bytes,
    packed_tile_bytes,
    packed_versions_bytes,
    scan_message_bytes,
    status_bytes,
    tile_in_message_bytes,
    tiles_message_bytes,
)
from imagine.sim.air_plan import brings_news, plan, source_and_tile
from imagine.sim.air_receive import is_live, peer_place
from imagine.sim.air_tiles import claim, copy_tile, find_spans

# these are those of mesh_comm.node, tile_exchange and digest
_PLAN_PERIOD_S = 0.2
_DIGEST_DATAGRAMS = 4
_DIGEST_SHARE, _MOST_DIGEST_S, _MOST_DIGEST_SHARE = 0.125, 1.5, 0.5
_STATUS_SHARE, _MOST_STATUS_S = 0.125, 2.0
_HERE_SHARE, _MOST_HERE_S = 0.2, 1.0
_SCANS_BEFORE_NEWS, _SCANS_BEFORE_REPEATS = 1, 4
_EPSILON_S = 1e-6
_MAX_PAYLOAD = MAX_DATAGRAM - OVERHEAD
_RESERVED_TILE, _RESERVED_TILES = 16, 15
_RESERVED_HOLDING, _RESERVED_DIGEST = 29, 24
_MOST_TILES = 256


@numba.njit(cache=True, nogil=True)
def canvas(air, world, drone, row, column):  # type: ignore[no-untyped-def]
    """Return (slot, first row, first column): where the next scan of `drone`, in cell (row, column), is to be drawn.

    The marks are `air.marks[world, drone, slot]` (int8 `[side, side or more]`), with an older scan to be painted over:
    -1 for a miss, +2 for a hit, 0 untouched. Their first cell is (first row, first column) of the grid; both may lie
    off it, and so may cells. With `side` = 2 n + 1, n the range cap in cells, rounded up, plus 1, the drone's cell is
    in the middle row, and the columns reach n to both sides. `send` takes the marks from there; what is drawn is kept
    until it has arrived.
    """
    node = air.nodes[world, drone]
    taken = node.busy_slots
    if node.pending_slot >= 0:
        taken |= 1 << node.pending_slot
    slot = 0
    while (taken >> slot) & 1 == 1:
        slot += 1
    node.canvas = slot
    marks, window = air.marks[world, drone, slot], air.windows[world, drone, slot]
    reach = marks.shape[0] // 2
    window.row, window.column = row - reach, (column - reach) // TILE * TILE
    return slot, window.row, window.column


@numba.njit(cache=True, nogil=True)
def send(air, world, tick, poses, velocity, alive, ranges, clocks, layers, versions):  # type: ignore[no-untyped-def]
    """Let every drone of `world` that is `alive` say at `tick` what it has to say; call it once own scans are mapped.

    `poses` `[drones, 3]` and `velocity` `[drones, 2 or more]` in the map frame; `ranges` float32 `[drones, beams]` as
    they were mapped, their marks drawn on each drone's `canvas`; `clocks` `[drones]` the own layers' clocks. `layers`
    and `versions` as in `deliver`.
    """
    rules = air.rules
    now = tick / rules.ticks_per_s
    nodes, messages, counters, peers = air.nodes[world], air.messages[world], air.counters[world], air.peers[world]
    for drone in range(layers.shape[0]):
        if not alive[drone]:
            continue
        node = nodes[drone]
        node.tokens = min(rules.burst, node.tokens + air.media[world, BUDGET] / rules.ticks_per_s)
        live = 0  # a bit for each peer in touch
        for peer in range(layers.shape[0]):
            if is_live(peers[drone, peer], tick, rules):
                live |= 1 << peer
        shares = live != 0 and rules.shares
        can_offer = node.canvas >= 0 and now >= node.next_scan - _EPSILON_S and node.scans < air.windows.shape[2] - 1
        changed = shares and can_offer and np.int64(clocks[drone]) != node.scan_clock
        if changed and _is_worth_telling(
            node,
            now,
            rules,
            clocks[drone],
            layers[drone, drone],
            versions[drone, drone],
            air.known[world, drone],
            counters[drone],
        ):
            # it replaces one that still waits; a slot stays free for the next canvas
            node.pending_slot, node.pending_clock = node.canvas, np.int64(clocks[drone])
            packed = packed_ranges_bytes(ranges[drone], rules.range_min, rules.range_cap)
            node.pending_bytes = scan_message_bytes(packed, node.pending_clock)
            window = air.windows[world, drone, node.pending_slot]
            window.clock = node.pending_clock
            window.x, window.y, window.yaw = poses[drone, 0], poses[drone, 1], poses[drone, 2]
            find_spans(air.marks[world, drone, node.pending_slot], air.spans[world, drone, node.pending_slot])
        node.canvas = -1
        if shares and now >= node.next_digest - _EPSILON_S:
            node.next_digest = now + rules.digest_period
            node.digest_units = layers.shape[1] * _units(versions.shape[2] * versions.shape[3])
            node.digest_parts = _DIGEST_DATAGRAMS
            node.digest_at, node.digest_bytes = now, 0
        if now >= node.next_plan - _EPSILON_S:
            node.next_plan = now + _PLAN_PERIOD_S
            plan(air, world, tick, drone, live if rules.shares else 0, layers, versions)
        if now >= node.next_status - _EPSILON_S:
            said = _send_status(
                rules, now, node, messages[drone], counters[drone], peers[drone], poses[drone], velocity[drone], live,
                air.media[world, BUDGET],
            )  # fmt: skip
            if not said:
                continue
        period = rules.pose_period
        if node.pending_clock == 0 and _is_near(peers[drone], poses[drone], tick, rules):
            period = min(period, rules.near_pose_period)  # a scan that waits will tell it
        period = max(period, min(_MOST_HERE_S, here_bytes() / (_HERE_SHARE * air.media[world, BUDGET])))
        is_due = now >= node.pose_told_at + period - _EPSILON_S
        if is_due and not _send_here(
            rules, now, node, messages[drone], counters[drone], poses[drone], velocity[drone]
        ):  # fmt: skip
            continue
        if node.digest_units > 0 and node.digest_parts > 0:
            said = _send_digests(
                rules, now, drone, node, messages[drone], counters[drone], air.digests[world, drone], versions[drone],
                air.media[world, BUDGET],
            )  # fmt: skip
            if not said:
                continue
        while True:  # by turns, as MeshNode._send_maps
            if node.wanted > 0 and (node.pending_clock == 0 or _is_tiles_turn(node, air.wanted[world, drone, 0])):
                if not _send_tiles(air, world, tick, drone, layers, versions):
                    break
                node.scans_ahead = 0
            elif node.pending_clock != 0:
                if not _send_scan(rules, now, node, messages[drone], counters[drone], air.windows[world, drone]):
                    break
                node.scans_ahead = node.scans_ahead + 1 if node.wanted > 0 else 1
            else:
                break


@numba.njit(cache=True, nogil=True)
def _is_worth_telling(node, now, rules, clock, cells, versions, known, counters):  # type: ignore[no-untyped-def]
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
def _is_tiles_turn(node, head):  # type: ignore[no-untyped-def]
    """Tell whether so many scans went ahead of the queue, whose first entry is `head`, that it has its turn."""
    return node.scans_ahead >= (_SCANS_BEFORE_NEWS if brings_news(head) else _SCANS_BEFORE_REPEATS)


@numba.njit(cache=True, nogil=True)
def _can_send(node, messages, size):  # type: ignore[no-untyped-def]
    """Tell whether the byte budget and the ring of messages have room."""
    return size <= node.tokens and node.messages < messages.shape[0]


@numba.njit(cache=True, nogil=True)
def _transmit(rules, now, node, messages, counters, kind, size):  # type: ignore[no-untyped-def]
    """Spend the bytes and put a message behind the sender's others on air; return its place in the ring, or -1.

    The radio drops what its queue does not hold, as `RadioMedium.send`; the node does not know, and has paid.
    """
    node.tokens -= size
    counters[BYTES_SENT + kind] += size
    counters[MESSAGES_SENT + kind] += 1
    start = max(now, node.busy_until)
    if (start - now) * rules.air_rate + size > rules.queue_bytes:
        node.dropped += 1
        return -1
    place = (node.first_message + node.messages) % messages.shape[0]
    message = messages[place]
    node.busy_until = start + size / rules.air_rate
    message.arrival = node.busy_until + rules.latency
    message.kind, message.size, message.sequence = kind, size, node.sequence
    node.sequence += 1
    node.messages += 1
    return place


@numba.njit(cache=True, nogil=True)
def _send_status(rules, now, node, messages, counters, peers, pose, velocity, live, budget):  # type: ignore[no-untyped-def]
    """Send where the drone is and whom it hears; False when bytes run short."""
    heard = 0
    for peer in range(peers.shape[0]):
        heard += peers[peer].heard_tick >= 0
    size = status_bytes(counters[:MESSAGES_SENT], heard)
    if not _can_send(node, messages, size):
        return False
    place = _transmit(rules, now, node, messages, counters, STATUS, size)
    if place >= 0:
        message = messages[place]
        message.x, message.y, message.yaw = pose[0], pose[1], pose[2]
        message.vx, message.vy, message.hears, message.slot = velocity[0], velocity[1], live, 0
    spread = min(_MOST_STATUS_S, size / (_STATUS_SHARE * budget))
    node.next_status, node.pose_told_at = now + max(rules.status_period, spread), now
    return True


@numba.njit(cache=True, nogil=True)
def _is_near(peers, pose, tick, rules):  # type: ignore[no-untyped-def]
    """Tell whether a peer in touch is taken to be near."""
    for peer in range(peers.shape[0]):
        x, y, found = peer_place(peers[peer], tick, rules)
        if found and np.hypot(x - pose[0], y - pose[1]) <= rules.near:
            return True
    return False


@numba.njit(cache=True, nogil=True)
def _send_here(rules, now, node, messages, counters, pose, velocity):  # type: ignore[no-untyped-def]
    """Send where the drone is; False when bytes run short."""
    size = here_bytes()
    if not _can_send(node, messages, size):
        return False
    place = _transmit(rules, now, node, messages, counters, STATUS, size)
    if place >= 0:
        message = messages[place]
        message.x, message.y, message.yaw = pose[0], pose[1], pose[2]
        message.vx, message.vy, message.slot = velocity[0], velocity[1], 1
    node.pose_told_at = now
    return True


@numba.njit(cache=True, nogil=True)
def _units(tiles):  # type: ignore[no-untyped-def]
    """Return into how many units a digest cuts the tiles of one source."""
    return (tiles + UNIT_TILES - 1) // UNIT_TILES


@numba.njit(cache=True, nogil=True)
def _send_digests(rules, now, drone, node, messages, counters, digests, versions, budget):  # type: ignore[no-untyped-def]
    """Tell which tiles of others are held, in as many datagrams as that takes; a long digest goes on the next time.

    `versions` are those that the drone holds, `[source, tile rows, tile columns]`. False when bytes run short.
    """
    sources, tile_columns, slots = versions.shape[0], versions.shape[2], digests.shape[0]
    tiles = versions.shape[1] * tile_columns
    units = _units(tiles)
    while node.digest_units > 0 and node.digest_parts > 0:
        first = node.digest_unit
        last, reserved, holdings, packed = first, _RESERVED_DIGEST, 0, 0
        while last < sources * units and last - first < node.digest_units:
            source, begin, held = last // units, last % units * UNIT_TILES, 0
            if source != drone:
                for tile in range(begin, min(begin + UNIT_TILES, tiles)):
                    held += versions[source, tile // tile_columns, tile % tile_columns] > 0
            if held > 0:
                size = packed_versions_bytes(held)
                if holdings > 0 and reserved + size + _RESERVED_HOLDING > _MAX_PAYLOAD:
                    break
                reserved += size + _RESERVED_HOLDING
                holdings += 1
                packed += size
            last += 1
        size = digest_message_bytes(holdings, packed)
        if node.digests == slots or not _can_send(node, messages, size):
            return False
        place = _transmit(rules, now, node, messages, counters, DIGEST, size)
        if place >= 0:
            messages[place].first_unit, messages[place].last_unit = first, last
            copy = digests[(node.first_digest + node.digests) % slots]
            for source in range(first // units, (last - 1) // units + 1):
                for tile in range(tiles):
                    copy[source, tile] = versions[source, tile // tile_columns, tile % tile_columns]
            node.digests += 1
        node.digest_bytes += size
        spread = min(_MOST_DIGEST_S, node.digest_bytes / (_DIGEST_SHARE * budget))
        spread = max(spread, node.digest_bytes / (_MOST_DIGEST_SHARE * budget))
        node.next_digest = max(node.next_digest, node.digest_at + spread)
        node.digest_units -= last - first
        node.digest_parts -= 1
        node.digest_unit = last % (sources * units)
    return True


@numba.njit(cache=True, nogil=True)
def _send_scan(rules, now, node, messages, counters, windows):  # type: ignore[no-untyped-def]
    """Send the scan that waits; False when bytes run short."""
    if not _can_send(node, messages, node.pending_bytes):
        return False
    place = _transmit(rules, now, node, messages, counters, SCAN, node.pending_bytes)
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
def _send_tiles(air, world, tick, drone, layers, versions):  # type: ignore[no-untyped-def]
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
    if count == 0 or not _can_send(node, messages, size):
        return False
    place = _transmit(air.rules, now, node, messages, counters, TILES, size)
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
