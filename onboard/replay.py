"""A LiDAR recording through the runner that flies: every scan is one `Runner.tick`, with the drone on the ground.

The autopilot's part is played by the recording: its yaw prior stands for the gyro's yaw, and nobody arms the vehicle.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from imagine.core.config import Settings
from imagine.core.errors import InputError, WorkError
from imagine.core.evidence import MAX_TILES, EvidenceMap
from imagine.core.frames import Pose
from imagine.core.lidar import Scan, returns
from imagine.core.mapping import MapSettings
from imagine.core.raster import CELL, TILE
from imagine.onboard.alignment import ate_rmse
from imagine.onboard.estimator import EstimatorSettings
from imagine.onboard.map_image import draw_map
from imagine.onboard.perception import Perception, PerceptionResult, PerceptionSettings
from imagine.onboard.recordings import Recording, open_recording
from imagine.onboard.records import Telemetry, TickInput
from imagine.onboard.runner import Runner
from imagine.onboard.settings import DroneSettings

logger = logging.getLogger(__name__)

Progress = Callable[[int, int], None]
"""Called with the scans done and the scans in all."""


RECORDED_MOTION = EstimatorSettings(acceleration_mps2=8.0, yaw_rate_rad_s=0.5)
"""Robots and hands stop harder than a drone, and wheels slip: Freiburg 079's err by up to 9° between two scans."""


class ReplaySettings(Settings):
    """How a recording is replayed."""

    perception: PerceptionSettings = Field(
        default_factory=lambda: PerceptionSettings(estimator=RECORDED_MOTION), description="odometry and estimator"
    )
    range_cap_m: float = Field(
        default=10.0, gt=0.5, le=30.0, description="beams are mapped up to here; flight maps less far, metres"
    )
    clear_without_return: bool = Field(
        default=False, description="whether beams without a return clear the map; glass and black surfaces return none"
    )
    min_returns: int = Field(
        default=100, ge=1, description="a recording whose median scan has fewer returns is too sparse to track"
    )


@dataclass(frozen=True)
class ReplayResult:
    """What came of a recording: where the sensor went, how well it was tracked, and the map.

    `trajectory` holds one pose per scan, map frame (the first scan's pose is the origin); `ate_rmse_m` is None where
    the recording has no reference poses; `scan_ms` is the time each scan took, milliseconds.
    """

    scans: int
    tracked: int
    stamps: tuple[float, ...]
    trajectory: tuple[Pose, ...] = field(repr=False)
    scan_ms: tuple[float, ...] = field(repr=False)
    ate_rmse_m: float | None
    evidence: EvidenceMap = field(repr=False)

    def as_json(self) -> dict[str, Any]:
        """Return the result as `imagine replay --json` writes it."""
        out: dict[str, Any] = {"scans": self.scans, "tracked": self.tracked}
        if self.ate_rmse_m is not None:
            out["ate_rmse_m"] = round(self.ate_rmse_m, 4)
        p50, p99 = np.percentile(self.scan_ms, (50, 99))
        out["scan_ms"] = {"p50": round(float(p50), 3), "p99": round(float(p99), 3)}
        out["trajectory"] = [[stamp, *pose] for stamp, pose in zip(self.stamps, self.trajectory, strict=True)]
        return out


def replay(
    recording: Recording, settings: ReplaySettings | None = None, on_progress: Progress | None = None
) -> ReplayResult:
    """Tick a runner with every scan of a recording.

    Raises WorkError where the scans are too sparse to track, or track is lost: a map drawn on would be wrong.
    """
    settings = settings or ReplaySettings()
    _refuse_sparse(recording, settings.min_returns)
    perception = _Overheard(recording.spec, settings.perception)
    drone = DroneSettings(policy=None, map=MapSettings(range_cap_m=settings.range_cap_m))
    evidence = EvidenceMap(drone.drone_id, max_extent_m=MAX_TILES * TILE * CELL)  # a recording's corridors may be long
    runner = Runner(drone, None, perception, evidence, None)
    runner.lidar = recording.spec  # the recording's own sensor in place of the drone's
    poses: list[Pose] = []
    scan_ms: list[float] = []
    tracked = 0
    for number, record in enumerate(recording.records, start=1):
        scan = record.scan if settings.clear_without_return else _returns_only(record.scan)
        yaw = record.yaw_prior
        telemetry = None if yaw is None else Telemetry(scan.stamp, yaw=yaw)
        started = time.perf_counter()
        output = runner.tick(TickInput(scan.stamp, scan, telemetry))
        scan_ms.append((time.perf_counter() - started) * 1e3)
        poses.append(output.status.pose)
        tracked += output.status.tracked
        result = perception.last
        if result is None:
            raise WorkError(f"{recording.path}: scan {number} is not newer than the one before it")
        if not result.ok:
            logger.warning("scan %d not tracked: %s", number, result.reason)
        if result.lost:
            raise WorkError(_lost_message(recording, number, settings.perception.lost_after, result))
        if on_progress is not None:
            on_progress(number, len(recording.records))
    return ReplayResult(
        scans=len(recording.records),
        tracked=tracked,
        stamps=tuple(record.scan.stamp for record in recording.records),
        trajectory=tuple(poses),
        scan_ms=tuple(scan_ms),
        ate_rmse_m=_ate(recording, poses),
        evidence=runner.evidence,
    )


class _Overheard(Perception):
    """Perception that keeps its latest result, for the messages of a replay that loses track."""

    last: PerceptionResult | None = None

    def update(self, scan: Scan, yaw_prior: float | None = None) -> PerceptionResult:
        """Perceive, and remember what came of it."""
        self.last = super().update(scan, yaw_prior)
        return self.last


def replay_file(
    path: Path,
    settings: ReplaySettings | None = None,
    json_path: Path | None = None,
    map_path: Path | None = None,
    verify: bool = False,
    on_progress: Progress | None = None,
) -> ReplayResult:
    """Replay a file, and write the result and the map where asked.

    `verify` replays it a second time and compares the poses bit for bit. Raises InputError on a bad recording or a
    place that cannot be written to, WorkError where track is lost or the second run differs.
    """
    for out in (json_path, map_path):
        if out is not None:
            _refuse_unwritable(out)
    recording = open_recording(path)
    result = replay(recording, settings, on_progress)
    if verify:
        verify_replay(recording, settings, result)
    if json_path is not None:
        json_path.write_text(json.dumps(result.as_json(), allow_nan=False) + "\n", encoding="utf-8")
    if map_path is not None:
        track = [[(pose.x, pose.y) for pose in result.trajectory]]
        draw_map(result.evidence.belief(), result.evidence.origin_cells, track).save(map_path, format="PNG")
    return result


def verify_replay(recording: Recording, settings: ReplaySettings | None, result: ReplayResult) -> None:
    """Replay once more and compare. Raises WorkError naming the first scan whose pose differs in any bit."""
    again = replay(recording, settings)
    for number, (first, second) in enumerate(zip(result.trajectory, again.trajectory, strict=True), start=1):
        if first != second:
            raise WorkError(f"{recording.path}: two replays differ from scan {number} on: {first} and {second}")


def _returns_only(scan: Scan) -> Scan:
    return Scan(scan.stamp, np.where(np.isfinite(scan.ranges), scan.ranges, np.float32(np.nan)))


def _refuse_sparse(recording: Recording, min_returns: int) -> None:
    counts = [int(returns(record.scan, recording.spec).sum()) for record in recording.records]
    median = int(np.median(counts))
    if median < min_returns:
        raise WorkError(
            f"{recording.path}: too sparse to track: {median} returns of {recording.spec.beams} beams in the median "
            f"scan, needs {min_returns}; record with a denser sensor, slower rotation or brighter surfaces"
        )


def _lost_message(recording: Recording, number: int, lost_after: int, result: PerceptionResult) -> str:
    stamps = [record.scan.stamp for record in recording.records[:number]]
    gap = float(np.median(np.diff(stamps))) if len(stamps) > 1 else math.nan
    return (
        f"{recording.path}: lost track at scan {number - lost_after + 1} of {len(recording.records)} "
        f"({result.reason}); its scans come {gap:.2f} s apart, and each must see most of what the last one saw: "
        "record at 4 Hz or more, or move and turn more slowly"
    )


def _ate(recording: Recording, poses: list[Pose]) -> float | None:
    pairs = [
        ((pose.x, pose.y), (record.reference.x, record.reference.y))
        for pose, record in zip(poses, recording.records, strict=True)
        if record.reference is not None
    ]
    if len(pairs) < 2:
        return None
    estimate, reference = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    return ate_rmse(estimate, reference)


def _refuse_unwritable(path: Path) -> None:
    if path.is_dir() or not path.parent.is_dir():
        what = "is a folder" if path.is_dir() else f"its folder {path.parent} does not exist"
        raise InputError(f"{path}: cannot be written: {what}")
