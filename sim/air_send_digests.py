"""Digests in the batched air: which tiles each drone says it holds, as `Speaking` and `mesh_comm.digest` do."""

from __future__ import annotations

import numba

from imagine.mesh_comm.messages import MAX_DATAGRAM
from imagine.mesh_comm.seal import OVERHEAD
from imagine.sim.air import DIGEST, UNIT_TILES
from imagine.sim.air_costs import digest_message_bytes, packed_versions_bytes
from imagine.sim.air_transmit import can_send, transmit

# these are those of mesh_comm.speaking and digest
DIGEST_DATAGRAMS = 4
"""So many datagrams of a long digest go out a period."""
_DIGEST_SHARE, _MOST_DIGEST_S, _MOST_DIGEST_SHARE = 0.125, 1.5, 0.5
_MAX_PAYLOAD = MAX_DATAGRAM - OVERHEAD
_RESERVED_HOLDING, _RESERVED_DIGEST = 29, 24


@numba.njit(cache=True, nogil=True)
def digest_units(tiles):  # type: ignore[no-untyped-def]
    """Return into how many units a digest cuts the tiles of one source."""
    return (tiles + UNIT_TILES - 1) // UNIT_TILES


@numba.njit(cache=True, nogil=True)
def send_digests(rules, now, drone, node, messages, counters, digests, versions, budget):  # type: ignore[no-untyped-def]
    """Tell which tiles of others are held, in as many datagrams as that takes; a long digest goes on the next time.

    `versions` are those that the drone holds, `[source, tile rows, tile columns]`. False when bytes run short.
    """
    sources, tile_columns, slots = versions.shape[0], versions.shape[2], digests.shape[0]
    tiles = versions.shape[1] * tile_columns
    units = digest_units(tiles)
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
        if node.digests == slots or not can_send(node, messages, size):
            return False
        place = transmit(rules, now, node, messages, counters, DIGEST, size)
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
