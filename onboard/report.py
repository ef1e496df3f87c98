"""What a flight leaves behind: the numbers of one drone, as JSON, and its map."""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from imagine.core.errors import InputError, WorkError
from imagine.core.evidence import EvidenceMap
from imagine.mesh_comm.node import MeshNode
from imagine.onboard.ladder import Decider
from imagine.onboard.phases import Phase
from imagine.onboard.places import PeerPlaces
from imagine.onboard.records import Event, TickOutput

_TRACK_STEP_M = 0.02  # shorter moves are estimate noise, not distance flown


class FlightRecord:
    """Collects what the report tells, tick by tick."""

    def __init__(self, drone_id: int) -> None:
        """Start empty."""
        self.drone_id = drone_id
        self.setpoints = 0
        self.distance_m = 0.0
        self.decided_by = {rung.value: 0 for rung in Decider}
        self.events: list[Event] = []
        self.tick_ms: list[float] = []
        self.trajectory: list[tuple[float, float, float, float]] = []
        self.phase, self.reason = Phase.PREPARE.value, ""
        self.dropped: Counter[str] = Counter()
        self._last_place: tuple[float, float] | None = None

    def add(self, output: TickOutput, tick_ms: float) -> None:
        """Take one tick's output and how long it took, milliseconds."""
        self.tick_ms.append(tick_ms)
        self.events += output.events
        status = output.status
        self.phase, self.reason = status.phase, status.reason
        if output.setpoint is not None:
            self.setpoints += 1
            if status.decider in self.decided_by and status.phase == Phase.EXPLORE.value:
                self.decided_by[status.decider] += 1
        if output.odometry is not None:
            x, y, yaw = output.odometry.pose
            self.trajectory.append((output.odometry.stamp, x, y, yaw))
            self._travel(x, y)

    def _travel(self, x: float, y: float) -> None:
        if self._last_place is None:
            self._last_place = (x, y)
            return
        step = math.hypot(x - self._last_place[0], y - self._last_place[1])
        if step >= _TRACK_STEP_M:
            self.distance_m += step
            self._last_place = (x, y)

    def as_json(self, evidence: EvidenceMap, mesh: MeshNode | None, places: PeerPlaces | None = None) -> dict[str, Any]:
        """Return the report: metres, milliseconds, cells, bytes; `trajectory` rows are stamp, x, y, yaw.

        `trajectory` is in the drone's own frame; `places` tells when it knew where its peers' frames lie in it.
        """
        own = int(np.count_nonzero(evidence.layers[evidence.own].cells))
        p50, p99 = np.percentile(self.tick_ms, (50, 99)) if self.tick_ms else (0.0, 0.0)
        return {
            "id": self.drone_id,
            "phase": self.phase,
            "reason": self.reason,
            "distance_m": round(self.distance_m, 3),
            "own_cells": mesh.own_cells if mesh is not None else own,
            "scan_cells": mesh.scan_cells if mesh is not None else 0,
            "map_cells": mesh.map_cells if mesh is not None else 0,
            "bytes_sent": dict(mesh.bytes_sent) if mesh is not None else dict.fromkeys(SENT_KINDS, 0),
            "receipts": _receipts(mesh),
            "frame": mesh.settings.frame if mesh is not None else None,
            "peers": _peers(places),
            "setpoints": self.setpoints,
            "decided_by": dict(self.decided_by),
            "failsafes": [_row(event) for event in self.events if event.kind == "failsafe"],
            "events": [_row(event) for event in self.events],
            "ticks": len(self.tick_ms),
            "tick_ms": {
                "p50": round(float(p50), 3),
                "p99": round(float(p99), 3),
                "max": round(max(self.tick_ms, default=0.0), 3),
            },
            "dropped": dict(sorted(self.dropped.items())),
            "trajectory": [[round(value, 5) for value in row] for row in self.trajectory],
        }


SENT_KINDS = ("scan", "tile", "digest", "status")


def write_report(path: Path, report: dict[str, Any]) -> None:
    """Write a report in one piece: a reader sees the whole of it or nothing.

    Raises InputError if it cannot, WorkError for a report that holds a number that is not finite.
    """
    fresh = path.with_name(f"{path.name}.{os.getpid()}.new")
    try:
        fresh.write_text(json.dumps(report, allow_nan=False), encoding="utf-8")
        fresh.replace(path)
    except OSError as error:
        raise InputError(f"{path}: the report cannot be written: {error.strerror}") from error
    except ValueError as error:
        raise WorkError(f"{path}: the report cannot be written: {error}") from error


def write_map(path: Path, evidence: EvidenceMap) -> None:
    """Write belief (int8 `[rows, columns]`) and origin (column, row of its first cell, 0.1 m cells) as .npz."""
    try:
        with path.open("wb") as file:
            np.savez_compressed(
                file, belief=evidence.belief(), own=evidence.layers[evidence.own].cells, origin=evidence.origin_cells
            )
    except OSError as error:
        raise InputError(f"{path}: the map cannot be written: {error.strerror}") from error


def _receipts(mesh: MeshNode | None) -> dict[str, dict[str, int]]:
    """Return what the bytes of scans and tiles bought (`mesh_comm/receipts.py`), by kind; empty without mesh."""
    return {} if mesh is None else {str(kind): asdict(receipt) for kind, receipt in mesh.receipts.items()}


def _peers(places: PeerPlaces | None) -> list[dict[str, Any]]:
    """Return every peer heard, by id: its standing at the end, and since when (seconds) its map counted."""
    return [
        {
            "id": peer,
            "standing": place.standing,
            "placed_s": None if place.placed_s is None else round(place.placed_s, 3),
        }
        for peer, place in sorted((places.by_peer if places is not None else {}).items())
    ]


def _row(event: Event) -> dict[str, Any]:
    return {"time_s": round(event.stamp, 3), "kind": event.kind, "text": event.text}
