"""The sending half of the batched air: what each drone puts on air, in which order, within its budget of bytes.

As `MeshNode.offer_scan` and `poll`, `TileExchange.plan` and `RadioMedium.send`. All arrays but the air's own are those
of one world. What is said is in `air_send_poses`, `air_send_digests` and `air_send_maps`.
"""

from __future__ import annotations

import numba
import numpy as np

from imagine.core.raster import TILE
from imagine.sim.air import BUDGET
from imagine.sim.air_costs import packed_ranges_bytes, scan_message_bytes
from imagine.sim.air_plan import plan
from imagine.sim.air_receive import is_live
from imagine.sim.air_send_digests import DIGEST_DATAGRAMS, digest_units, send_digests
from imagine.sim.air_send_maps import is_tiles_turn, is_worth_telling, send_scan, send_tiles
from imagine.sim.air_send_poses import is_here_due, send_here, send_status
from imagine.sim.air_tiles import find_spans

_PLAN_PERIOD_S = 0.2  # as in mesh_comm.speaking
_EPSILON_S = 1e-6


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
        if changed and is_worth_telling(
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
            node.digest_units = layers.shape[1] * digest_units(versions.shape[2] * versions.shape[3])
            node.digest_parts = DIGEST_DATAGRAMS
            node.digest_at, node.digest_bytes = now, 0
        if now >= node.next_plan - _EPSILON_S:
            node.next_plan = now + _PLAN_PERIOD_S
            plan(air, world, tick, drone, live if rules.shares else 0, layers, versions)
        if now >= node.next_status - _EPSILON_S:
            said = send_status(
                rules, now, node, messages[drone], counters[drone], peers[drone], poses[drone], velocity[drone], live,
                air.media[world, BUDGET],
            )  # fmt: skip
            if not said:
                continue
        is_due = is_here_due(rules, tick, node, peers[drone], poses[drone], air.media[world, BUDGET])
        if is_due and not send_here(
            rules, now, node, messages[drone], counters[drone], poses[drone], velocity[drone]
        ):  # fmt: skip
            continue
        if node.digest_units > 0 and node.digest_parts > 0:
            said = send_digests(
                rules, now, drone, node, messages[drone], counters[drone], air.digests[world, drone], versions[drone],
                air.media[world, BUDGET],
            )  # fmt: skip
            if not said:
                continue
        while True:  # by turns, as MeshNode._send_maps
            if node.wanted > 0 and (node.pending_clock == 0 or is_tiles_turn(node, air.wanted[world, drone, 0])):
                if not send_tiles(air, world, tick, drone, layers, versions):
                    break
                node.scans_ahead = 0
            elif node.pending_clock != 0:
                if not send_scan(rules, now, node, messages[drone], counters[drone], air.windows[world, drone]):
                    break
                node.scans_ahead = node.scans_ahead + 1 if node.wanted > 0 else 1
            else:
                break
