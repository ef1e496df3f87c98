"""What a simulated flight comes to: the numbers the terminal shows and `--json` writes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine.core.frames import IDENTITY, Pose, compose
from imagine.mesh_comm.settings import Frame
from imagine.onboard.ladder import Decider
from imagine.onboard.report import SENT_KINDS
from imagine.sim.server import TickRecord

DECIDERS = tuple(rung.value for rung in Decider)


@dataclass
class FlightLog:
    """Collected while flying: coverage by tick, the true poses at every stamp, the latest record.

    `frames`: where each drone's own frame lies in the twin's, by number; what it reports is in its own.
    """

    frame: Frame = "shared"
    frames: dict[int, Pose] = field(default_factory=dict)
    coverage: list[float] = field(default_factory=list)
    truth: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    last: TickRecord | None = None

    def add(self, record: TickRecord, coverage: float) -> None:
        """Take one tick."""
        self.coverage.append(coverage)
        self.truth[_stamp_key(record.time_s)] = record.poses
        self.last = record


def results(
    log: FlightLog, reports: dict[int, dict[str, Any] | None], deaths: dict[int, str], wall_s: float, start_s: float
) -> dict[str, Any]:
    """Return the flight's JSON; `reports` and `deaths` are by drone number, `start_s` seconds to the first motion."""
    record = log.last
    drones = [_drone(number, report, deaths.get(number, ""), log) for number, report in sorted(reports.items())]
    tick_ms = [report["tick_ms"] for report in reports.values() if report is not None]
    return {
        "frame": log.frame,
        "coverage": round(log.coverage[-1], 4) if log.coverage else 0.0,
        "ticks": len(log.coverage),
        "t90": _first_at_least(log.coverage, 0.90),
        "t95": _first_at_least(log.coverage, 0.95),
        "collisions": int(record.contacts.sum()) if record is not None else 0,
        "wall_s": round(wall_s, 2),
        "first_motion_s": round(start_s, 2),
        "tick_ms": {
            # of the runners: the median drone's median, and the worst of the worst
            "p50": float(np.median([t["p50"] for t in tick_ms])) if tick_ms else 0.0,
            "p99": max((t["p99"] for t in tick_ms), default=0.0),
            "max": max((t["max"] for t in tick_ms), default=0.0),
        },
        "decided_by": {rung: sum(d["decided_by"][rung] for d in drones) for rung in DECIDERS},
        "coverage_curve": [round(c, 5) for c in log.coverage],
        "drones": drones,
    }


def _drone(number: int, report: dict[str, Any] | None, death: str, log: FlightLog) -> dict[str, Any]:
    vehicle = log.last.vehicles[number - 1] if log.last is not None else None
    failsafes = [
        {"time_s": round(f.time_s, 2), "kind": "vehicle", "text": f.reason}
        for f in (vehicle.failsafes if vehicle is not None else ())
    ]
    found = report or {}
    trajectory = found.get("trajectory", [])
    return {
        "id": number,
        # of a drone that was killed nobody knows: null, not zero
        "distance_m": found.get("distance_m"),
        "own_cells": found.get("own_cells"),
        "scan_cells": found.get("scan_cells"),
        "map_cells": found.get("map_cells"),
        "bytes_sent": found.get("bytes_sent", dict.fromkeys(SENT_KINDS)),
        "receipts": found.get("receipts"),
        "peers": found.get("peers"),
        "setpoints": found.get("setpoints"),
        "pose_rmse_m": pose_rmse(trajectory, log.truth, number - 1, log.frames.get(number, IDENTITY)),
        "decided_by": found.get("decided_by", dict.fromkeys(DECIDERS, 0)),
        "tick_ms": found.get("tick_ms"),
        "phase": found.get("phase", "lost"),
        "reason": found.get("reason", ""),
        "failsafes": failsafes + [{**f, "kind": "runner"} for f in found.get("failsafes", [])],
        "error": death,
    }


def pose_rmse(
    trajectory: list[list[float]], truth: dict[int, NDArray[np.float64]], index: int, frame: Pose = IDENTITY
) -> float | None:
    """Return the rms distance (m) of an estimated trajectory (rows stamp, x, y, yaw) to the true poses.

    `frame` is where the trajectory's frame lies in that of the truth: the drone's launch, which it starts at exactly.
    """
    rows = [(stamp, *compose(frame, Pose(x, y, yaw))) for stamp, x, y, yaw in trajectory]
    squares = [
        (x - truth[_stamp_key(stamp)][index, 0]) ** 2 + (y - truth[_stamp_key(stamp)][index, 1]) ** 2
        for stamp, x, y, _ in rows
        if _stamp_key(stamp) in truth
    ]
    return round(math.sqrt(sum(squares) / len(squares)), 4) if squares else None


def _stamp_key(stamp: float) -> int:
    return round(stamp * 1000.0)


def _first_at_least(curve: list[float], share: float) -> int | None:
    return next((tick + 1 for tick, value in enumerate(curve) if value >= share), None)
