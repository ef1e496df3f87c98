"""Which tiles a drone of the batched air sends next, as `mesh_comm.tile_exchange` plans them."""

from __future__ import annotations

import numba
import numpy as np

from imagine.core.raster import TILE
from imagine.mesh_comm.information import (
    FRONTIER_WORTH,
    MOST_DENSITY,
    TYPICAL_TILE_BYTES,
    density,
    known_cells,
    tile_news,
    unsent_share,
)
from imagine.sim.air import MOST_DRONES, MOST_WANTED, NEVER

_DIGEST_GRACE_S, _EPSILON_S = 0.25, 1e-6  # as in mesh_comm.tile_exchange
_ROWS, _PLACES, _SOURCES, _STALE, _MISSING = 1 << 12, 1 << 24, 1 << 6, 1 << 24, 1 << 6  # digits of a queue entry
_NEWS = MOST_DENSITY + 1  # ranks below are of tiles that tell something new


@numba.njit(cache=True, nogil=True)
def brings_news(entry):  # type: ignore[no-untyped-def]
    """Tell whether the tile of a queue entry tells some peer a cell that it does not know."""
    return entry // (_PLACES * _SOURCES * 2) < _NEWS


@numba.njit(cache=True, nogil=True)
def plan(air, world, tick, drone, live, layers, versions):  # type: ignore[no-untyped-def]
    """Queue the tiles that some peer in touch, by its last digest, lacks.

    Those come first that tell most new cells a byte, then, once a period, those that only confirm: most lacking first,
    then most outdated. The queue is `air.wanted` up to `wanted` of the drone's node; an entry is its rank and place in
    one number, least first. `live` has a bit for each peer in touch.
    """
    rules, node, peers = air.rules, air.nodes[world, drone], air.peers[world, drone]
    rate, drones, tile_columns = rules.ticks_per_s, versions.shape[1], versions.shape[3]
    now = tick / rate
    wanted, holdings = air.wanted[world, drone], air.holdings[world, drone]
    repeats = node.wanted > 0 and not brings_news(wanted[node.wanted - 1])
    if now >= node.next_repeats - _EPSILON_S:
        node.next_repeats, repeats = now + rules.tile_period, True
    node.wanted = 0
    readers = 0  # a bit for each peer in touch that has told what it holds
    for peer in range(drones):
        if peers[peer].digest_tick >= 0:
            readers |= live & 1 << peer
    for source in range(drones):
        if readers == 0 or (source != drone and not rules.relays):
            continue
        held, notes = versions[drone, source], air.notes[world, drone, source]
        for tile in range(notes.shape[0]):
            row, column = tile // tile_columns, tile % tile_columns
            version = np.int64(held[row, column])
            if version == 0:
                continue
            note = notes[tile]
            was_sent = note.sent_tick > NEVER
            sent_at = note.sent_tick / rate
            if was_sent and now - sent_at < rules.tile_period - _EPSILON_S:
                continue
            missing, stale, worth = np.int64(0), np.int64(0), np.int64(0)
            for peer in range(drones):
                has = np.int64(holdings[peer, source, tile])
                if has >= version or (readers >> peer) & 1 == 0 or peer == source:
                    continue
                told_since = peers[peer].digest_tick / rate >= sent_at + _DIGEST_GRACE_S
                if was_sent and np.int64(note.sent_version) >= version and not told_since:
                    continue
                hear_each_other = (peers[peer].hears >> source) & (peers[source].hears >> peer) & (readers >> source)
                if source != drone and hear_each_other & 1 == 1:
                    continue  # the source sends this peer its newest tiles itself
                missing += np.int64(has == 0)
                stale += version - has
                if source != drone or has < np.int64(air.met[world, drone, peer, tile]):
                    fresh, edge, known = tile_news(
                        layers[drone, source], row * TILE, column * TILE, layers[drone, peer]
                    )  # fmt: skip
                    worth += unsent_share(fresh, edge, known, np.int64(note.sent_known) if has > 0 else 0)[1]
            if worth > 0 or (stale > 0 and repeats):
                if worth > 0:
                    size = np.int64(note.cost) if note.cost_version > 0 else TYPICAL_TILE_BYTES
                    rank = MOST_DENSITY - density(worth, size)
                else:
                    rank = (_MISSING - 1 - missing) * _STALE + _STALE - 1 - min(stale, np.int64(_STALE - 1)) + _NEWS
                place = column * _ROWS + row  # ties in the order of tile keys
                wanted[node.wanted] = ((rank * 2 + (source != drone)) * _SOURCES + source) * _PLACES + place
                node.wanted += 1
    if rules.relays:
        _plan_sketches(
            node, readers, drone, layers, versions, holdings, air.notes[world, drone], air.sketched[world, drone],
            wanted,
        )  # fmt: skip
    _sort(wanted, node.wanted)
    node.wanted = min(node.wanted, MOST_WANTED)


@numba.njit(cache=True, nogil=True)
def _plan_sketches(node, readers, drone, layers, versions, holdings, notes, sketched, wanted):  # type: ignore[no-untyped-def]
    """Queue the tiles with scans of sources out of reach, as `TileExchange._sketches`; `readers` has a bit a peer.

    `holdings`, `notes` and `sketched` are the drone's.
    """
    drones, tile_columns = versions.shape[1], versions.shape[3]
    for peer in range(drones):
        if (node.readers & ~readers) >> peer & 1 == 1:
            sketched[peer] = 0
    node.readers = readers
    for source in range(drones):
        if readers == 0 or source == drone or (readers >> source) & 1 == 1:
            continue
        for tile in range(notes.shape[1]):
            if notes[source, tile].provisional == 0:
                continue
            row, column = tile // tile_columns, tile % tile_columns
            known, worth = known_cells(layers[drone, source], row * TILE, column * TILE), np.int64(0)
            for peer in range(drones):
                has_same = holdings[peer, source, tile] == versions[drone, source, row, column]
                if (readers >> peer) & 1 == 0 or not has_same or np.int64(sketched[peer, source, tile]) >= known:
                    continue
                fresh, edge, _ = tile_news(layers[drone, source], row * TILE, column * TILE, layers[drone, peer])
                worth += fresh + FRONTIER_WORTH * edge
            if worth > 0:
                rank, place = MOST_DENSITY - density(worth, TYPICAL_TILE_BYTES), column * _ROWS + row
                wanted[node.wanted] = ((rank * 2 + 1) * _SOURCES + MOST_DRONES + source) * _PLACES + place
                node.wanted += 1


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


@numba.njit(cache=True, nogil=True)
def source_and_tile(entry):  # type: ignore[no-untyped-def]
    """Return (source, tile row, tile column) of a queue entry; of a sketch the source is MOST_DRONES greater."""
    return entry // _PLACES % _SOURCES, entry % _ROWS, entry % _PLACES // _ROWS
