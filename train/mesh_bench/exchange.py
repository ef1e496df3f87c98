"""Measured on recorded flights: agreement after a partition, bytes against whole maps, schedulers, handing over."""

from __future__ import annotations

import lzma
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine.core.raster import TILE
from imagine.mesh_comm.node import MeshSettings
from imagine.mesh_comm.settings import Scheduler
from imagine.sim.radio import RadioSettings
from imagine.train.mesh_bench.flights import TICK_S, Flight
from imagine.train.mesh_bench.team import Team
from imagine.train.mesh_bench.whole_maps import WholeMaps

Results = dict[str, dict[str, Any]]
NEAR = RadioSettings()
FAR = RadioSettings(range_m=1000.0)
"""Everyone hears everyone."""
SLOW_BYTES_PER_S = 2500.0
"""20 kbit/s."""
_LIMIT_S = 120.0


def reunion(flight: Flight) -> Results:
    """Explore without radio, then let all hear all: how long, and how many bytes, until all layers are equal."""
    end_s = flight.seconds
    team = Team(flight, MeshSettings(), FAR, is_open=lambda now: now > end_s + 1e-9).fly()
    before = sum(team.bytes_sent.values())
    while not team.agrees() and team.now < end_s + _LIMIT_S:
        team.tick()
    sent = team.bytes_sent
    cells = int(team.own().sum())
    return {
        "partition_heals": {
            "value": round(team.now - end_s, 3) if team.agrees() else None, "unit": "s",
            "bytes": sum(sent.values()) - before, "tile_bytes": sent["tile"], "cells": cells,
            "drones": flight.drones, "rate_bytes_per_s": team.mesh.rate_bytes_per_s,
        }
    }  # fmt: skip


def against_whole_maps(flights: Sequence[Flight], progress: Callable[[str], None]) -> Results:
    """Tell flights by the mesh and by whole maps over the same radio; count bytes and who knows how much when."""
    lead, lead_at_once, times = [], [], []
    sent: Counter[str] = Counter()
    whole, whole_at_once, reconnections = 0, 0, 0
    for number, flight in enumerate(flights):
        progress(f"against whole maps, flight {number + 1} of {len(flights)}")
        ours = Team(flight, MeshSettings(protocol="multi-hop"), NEAR)
        theirs = WholeMaps(flight, NEAR, rate_bps=NEAR.rate_bps)
        at_once = WholeMaps(flight, NEAR)
        ever = np.zeros_like(ours.meet().known())  # evidence for and against may cancel; whoever knew, knows
        while ours.ticks < len(flight.poses):
            for side in (ours, theirs, at_once):
                side.tick()
            ever |= ours.known()
            known = ever.sum(axis=(1, 2))
            lead.append(known - theirs.known().sum(axis=(1, 2)))
            lead_at_once.append(known - at_once.known().sum(axis=(1, 2)))
        sent.update(ours.bytes_sent)
        times.append(theirs.bytes_sent / sum(ours.bytes_sent.values()))
        whole, whole_at_once = whole + theirs.bytes_sent, whole_at_once + at_once.bytes_sent
        reconnections += theirs.reconnections
    return {
        "bytes_whole_maps_over_mesh": {
            "value": round(whole / sent.total(), 2), "unit": "times", "least": round(min(times), 2),
            "most": round(max(times), 2), "mesh_bytes": sent.total(), "mesh_by_kind": dict(sent),
            "whole_maps_bytes": whole, "whole_maps_bytes_unlimited": whole_at_once, "reconnections": reconnections,
            "map_bytes": theirs.map_bytes, "scan_bytes": theirs.scan_bytes,
            "seconds": round(sum(flight.seconds for flight in flights), 1),
        },
        "knows_at_least_whole_maps": _lead(np.concatenate(lead)),
        "knows_at_least_unlimited_whole_maps": _lead(np.concatenate(lead_at_once)),
    }  # fmt: skip


def _lead(lead: NDArray[np.int64]) -> dict[str, Any]:
    """Say in how many steps, of those of all drones, a drone of the mesh knows no fewer cells, and its lag."""
    return {
        "value": round(float((lead >= 0).mean()), 4), "unit": "share of steps", "steps": lead.size,
        "behind_by_over_4_cells": round(float((lead < -4).mean()), 4), "most_behind_cells": int(max(0, -lead.min())),
        "mean_lead_cells": round(float(lead.mean()), 1),
    }  # fmt: skip


def schedulers(flights: Sequence[Flight], rate_bytes_per_s: float, progress: Callable[[str], None]) -> Results:
    """Tell flights with little radio by both schedulers: the share of the team's cells that a drone knows, over time.

    Each flight is told over radios of 5 m, and over radios that hear all but are cut off for 20 s of every 30; each
    with the rate for every drone, and with the rate for all of them together. Beside them stands `bound`: a radio that
    tells those in reach all that its drone has seen, at once and for nothing.
    """
    results: Results = {}
    drones = flights[0].drones
    for name, radio, is_open, rate in (
        ("near", NEAR, _always, rate_bytes_per_s), ("cut", FAR, _cut, rate_bytes_per_s),
        ("shared_near", NEAR, _always, rate_bytes_per_s / drones), ("shared_cut", FAR, _cut, rate_bytes_per_s / drones),
    ):  # fmt: skip
        shares: dict[Scheduler, list[NDArray[np.float64]]] = {"information": [], "fifo": []}
        bounds: list[NDArray[np.float64]] = []
        bought: dict[Scheduler, list[float]] = {"information": [], "fifo": []}
        for number, flight in enumerate(flights):
            for scheduler in shares:
                progress(f"{scheduler} scheduler, {name} radio, flight {number + 1} of {len(flights)}")
                mesh = MeshSettings(scheduler=scheduler, rate_bytes_per_s=rate, burst_bytes=1250.0)
                team = Team(flight, mesh, radio, is_open=is_open)
                share, bound = _share_by_tick(team)
                shares[scheduler].append(share)
                if scheduler == "information":
                    bounds.append(bound)
                told = sum(receipt.cells for node in team.nodes for receipt in node.receipts.values())
                bought[scheduler].append(told / sum(team.bytes_sent.values()))
        results |= _compare(name, shares, bounds)
        results[f"scheduler_{name}_bought"] = {
            "value": round(float(np.mean(bought["information"])), 2), "unit": "cells/byte",
            "fifo": round(float(np.mean(bought["fifo"])), 2), "rate_bytes_per_s": round(rate, 1),
        }  # fmt: skip
    return results


def _always(_: float) -> bool:
    return True


def _cut(now: float) -> bool:
    return now % 30.0 >= 20.0


def _share_by_tick(team: Team) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fly to the end; return the mean share of the team's cells that its drones know, by tick, and could know at best.

    At best a drone knows all that those have seen who have been in its reach, up to when they last were.
    """
    shares, bounds = [], []
    known = team.meet().known()
    own, at_best = team.own(), known.copy()
    while team.ticks < len(team.flight.poses):
        team.tick()
        known, own = known | team.known(), own | team.own()
        for drone, hears in enumerate(team.reach | np.eye(len(own), dtype=np.bool_)):
            at_best[drone] |= own[hears].any(axis=0)
        all_cells = max(1, own.any(axis=0).sum())
        shares.append(known.sum(axis=(1, 2)).mean() / all_cells)
        bounds.append(at_best.sum(axis=(1, 2)).mean() / all_cells)
    return np.array(shares), np.array(bounds)


def _compare(
    name: str, shares: dict[Scheduler, list[NDArray[np.float64]]], bounds: list[NDArray[np.float64]]
) -> Results:
    """Give the mean over flights at every half minute, and of what a drone lacks over the whole flight."""
    results: Results = {}
    lacks = {scheduler: float(np.mean([1.0 - of.mean() for of in flown])) for scheduler, flown in shares.items()}
    results[f"scheduler_{name}_lacking"] = {
        "value": round(lacks["information"], 5), "unit": "share of the team's cells", "fifo": round(lacks["fifo"], 5),
        "bound": round(float(np.mean([1.0 - of.mean() for of in bounds])), 5), "flights": len(shares["fifo"]),
    }  # fmt: skip
    step = round(30.0 / TICK_S)
    for at in range(step, max(map(len, shares["fifo"])) + 1, step):
        rows = {
            scheduler: float(np.mean([of[at - step : at].mean() for of in flown if len(of) >= at]))
            for scheduler, flown in shares.items()
            if any(len(of) >= at for of in flown)
        }
        if rows:
            results[f"scheduler_{name}_{at * TICK_S:.0f}s"] = {
                "value": round(rows["information"], 5), "unit": "share of the team's cells, mean of 30 s",
                "fifo": round(rows["fifo"], 5),
                "bound": round(float(np.mean([of[at - step : at].mean() for of in bounds if len(of) >= at])), 5),
            }  # fmt: skip
    return results


def handover(flight: Flight) -> Results:
    """Let each drone hand its whole layer to one that knows nothing; bytes against xz -9 and raw float32."""
    end_s = flight.seconds
    team = Team(flight, MeshSettings(), FAR, is_open=lambda now: now > end_s + 1e-9).fly()
    while not team.agrees() and team.now < end_s + _LIMIT_S:
        team.tick(scans=False)
    layers = [evidence.layers[evidence.own].cells for evidence in team.maps]
    cut = [layer for layer in (_used(layer) for layer in layers) if layer.size]
    xz = sum(len(lzma.compress(np.sign(layer).tobytes(), preset=9)) for layer in cut)
    raw = sum(4 * layer.size for layer in cut)
    tiles = team.bytes_sent["tile"]
    return {
        "handover": {
            "value": round(tiles / len(cut)), "unit": "bytes a layer", "drones": len(cut),
            "xz_ternary_bytes": round(xz / len(cut)), "float32_bytes": round(raw / len(cut)),
            "over_xz": round(tiles / xz, 2), "float32_over_mesh": round(raw / tiles, 1),
            "cells": round(sum(int((layer != 0).sum()) for layer in cut) / len(cut)),
        }
    }  # fmt: skip


def _used(layer: NDArray[np.int8]) -> NDArray[np.int8]:
    """Cut a layer to the tiles that hold any evidence."""
    rows, columns = np.nonzero(layer)
    if not len(rows):
        return layer[:0]
    low, high = (rows.min() // TILE, columns.min() // TILE), (rows.max() // TILE + 1, columns.max() // TILE + 1)
    return layer[low[0] * TILE : high[0] * TILE, low[1] * TILE : high[1] * TILE]
