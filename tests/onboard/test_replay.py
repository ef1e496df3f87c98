"""Recordings through the onboard code: real ones where the data is at hand, a synthetic one everywhere."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from room_scans import ROUND, fly, measure

from imagine.core.errors import InputError, WorkError
from imagine.core.frames import IDENTITY, relative
from imagine.core.lidar import LD19, Scan
from imagine.core.raster import CELL
from imagine.onboard.alignment import align_planar, ate_rmse
from imagine.onboard.map_image import draw_map
from imagine.onboard.recordings import Record, Recording
from imagine.onboard.replay import ReplaySettings, replay, replay_file, verify_replay

DATA = Path(os.environ.get("IMAGINE_DATA", Path(__file__).resolve().parents[3] / "shared" / "data")) / "lidar"
real = pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings at {DATA} (set IMAGINE_DATA)")


def room_recording(scans: int = 60, step: int = 1) -> Recording:
    """Return a flight through the room as a recording, with its truth as the reference."""
    rng = np.random.default_rng(0)
    truth = fly(ROUND)[: scans * step : step]
    records = tuple(Record(measure(p, 0.1 * i, LD19, rng), p.yaw, p) for i, p in enumerate(truth))
    return Recording(Path("room.log"), "synthetic", LD19, records)


def write_carmen(path: Path, recording: Recording) -> Path:
    """Write the front half turn of a recording as a CARMEN log."""
    lines = []
    for record in recording.records:
        front = np.concatenate((record.scan.ranges[270:], record.scan.ranges[:90]))
        ranges = " ".join(f"{r:.3f}" if math.isfinite(r) else "81.9" for r in np.repeat(front, 2))
        p = record.reference or IDENTITY
        at = f"{p.x:.4f} {p.y:.4f} {p.yaw:.5f}"
        stamp = f"{record.scan.stamp + 1.0:.3f} host {record.scan.stamp + 1.0:.3f}"
        lines += [f"ODOM {at} 0 0 0 {stamp}", f"FLASER 360 {ranges} {at} {at} {stamp}"]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_a_room_is_tracked_and_mapped_true_to_scale() -> None:
    recording = room_recording(150)
    seen: list[tuple[int, int]] = []
    result = replay(recording, on_progress=lambda done, total: seen.append((done, total)))
    assert result.scans == result.tracked == len(result.trajectory) == 150
    assert seen[-1] == (150, 150)
    assert result.ate_rmse_m is not None
    assert result.ate_rmse_m < 0.05
    rows, columns = np.nonzero(result.evidence.belief() > 2)
    extent = (np.ptp(columns) * CELL, np.ptp(rows) * CELL)
    # turned by the launch yaw of zero: the room is 10 m x 8 m
    assert extent == (pytest.approx(10.0, abs=0.3), pytest.approx(8.0, abs=0.3))


def test_the_json_holds_the_promised_keys_and_the_map_is_a_picture(tmp_path: Path) -> None:
    path = write_carmen(tmp_path / "room.log", room_recording(60))
    result = replay_file(path, json_path=tmp_path / "out.json", map_path=tmp_path / "map.png", verify=True)
    out = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    assert set(out) == {"scans", "tracked", "ate_rmse_m", "scan_ms", "trajectory"}
    assert (out["scans"], out["tracked"]) == (60, 60)
    assert set(out["scan_ms"]) == {"p50", "p99"}
    assert len(out["trajectory"]) == 60
    assert out["trajectory"][0] == pytest.approx([1.0, 0.0, 0.0, 0.0], abs=1e-6)
    assert out["trajectory"][-1][1:] == pytest.approx(list(result.trajectory[-1]))
    with Image.open(tmp_path / "map.png") as picture:
        assert picture.format == "PNG"
        assert min(picture.size) > 300


def test_without_reference_poses_there_is_no_error_to_report() -> None:
    recording = room_recording(20)
    bare = Recording(recording.path, "x", LD19, tuple(r._replace(reference=None) for r in recording.records))
    result = replay(bare)
    assert result.ate_rmse_m is None
    assert "ate_rmse_m" not in result.as_json()


def test_a_result_that_differs_is_found_out() -> None:
    recording = room_recording(10)
    result = replay(recording)
    verify_replay(recording, None, result)
    poses = list(result.trajectory)
    poses[6] = poses[6]._replace(x=math.nextafter(poses[6].x, 9.0))
    with pytest.raises(WorkError, match="differ from scan 7 on"):
        verify_replay(recording, None, type(result)(**{**vars(result), "trajectory": tuple(poses)}))


def test_sparse_scans_are_refused_before_anything_is_drawn() -> None:
    recording = room_recording(30)
    thin = []
    for record in recording.records:
        ranges = np.full(360, np.nan, np.float32)
        ranges[::6] = record.scan.ranges[::6]
        thin.append(Record(Scan(record.scan.stamp, ranges)))
    with pytest.raises(WorkError, match=r"too sparse to track: 60 returns of 360 beams in the median scan.*denser"):
        replay(Recording(Path("thin.dat"), "x", LD19, tuple(thin)))


def test_scans_too_far_apart_end_in_an_error_that_names_the_scan_and_the_remedy() -> None:
    with pytest.raises(WorkError, match=r"lost track at scan \d+ of \d+ .*scans come 0\.10 s apart.*more slowly"):
        replay(room_recording(20, step=15))


def test_a_place_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"its folder .* does not exist"):
        replay_file(tmp_path / "missing.log", json_path=tmp_path / "no" / "out.json")
    with pytest.raises(InputError, match="is a folder"):
        replay_file(tmp_path / "missing.log", map_path=tmp_path)


@given(
    st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=3, max_size=40),
    st.floats(-math.pi, math.pi),
    st.floats(-20, 20),
    st.floats(-20, 20),
)
def test_alignment_undoes_any_rotation_and_shift(
    points: list[tuple[float, float]], yaw: float, x: float, y: float
) -> None:
    reference = np.array(points)
    c, s = math.cos(yaw), math.sin(yaw)
    moved = reference @ np.array([[c, s], [-s, c]]) + (x, y)
    np.testing.assert_allclose(align_planar(moved, reference), reference, atol=1e-6)
    assert ate_rmse(moved, reference) < 1e-6


def test_alignment_neither_scales_nor_mirrors() -> None:
    reference = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [4.0, 2.0]])
    assert ate_rmse(2.0 * reference, reference) > 0.5
    assert ate_rmse(reference * (1.0, -1.0), reference) > 0.3


def test_the_picture_shows_free_unknown_occupied_and_the_line() -> None:
    belief = np.zeros((64, 64), np.int8)
    belief[20:40, 20:40] = -8
    belief[20, 20:40] = 8  # the lowest row: south is down
    picture = draw_map(belief, (-32, -32), [[(-1.0, -0.5), (0.5, -0.5)]])
    colours = [picture.getpixel((picture.width // 2, y)) for y in range(picture.width)]
    assert colours[2] == (200, 200, 200)
    assert (255, 255, 255) in colours
    assert (0, 0, 0) in colours
    assert (215, 48, 39) in colours
    assert colours.index((255, 255, 255)) < colours.index((215, 48, 39)) < colours.index((0, 0, 0))


def test_an_empty_map_cannot_be_drawn() -> None:
    with pytest.raises(WorkError, match="empty"):
        draw_map(np.zeros((32, 32), np.int8), (0, 0))


@real
def test_freiburg_079_is_tracked_whole_within_thirty_centimetres() -> None:
    result = replay_file(DATA / "freiburg-079-first-1200.log.gz")
    assert result.tracked == result.scans == 1200
    assert result.ate_rmse_m is not None
    assert result.ate_rmse_m <= 0.10  # measured 0.07; the promise is 0.30


@real
@pytest.mark.parametrize(("name", "scans"), [("breezyslam-exp1.dat", 756), ("ccny-urg.csv.gz", 360)])
def test_recordings_without_odometry_are_tracked_whole_and_give_sharp_maps(name: str, scans: int) -> None:
    result = replay_file(DATA / name)
    assert result.tracked == result.scans == scans
    belief = result.evidence.belief()
    # a smeared map would be thick with walls and full of doubt
    assert np.count_nonzero(belief > 0) < 0.25 * np.count_nonzero(belief < 0)
    assert np.count_nonzero(np.abs(belief) >= 6) > 0.6 * np.count_nonzero(belief)


@real
def test_the_sparse_ydlidar_is_too_sparse_to_track() -> None:
    with pytest.raises(WorkError, match=r"too sparse to track: \d+ returns of 720 beams"):
        replay_file(DATA / "ydlidar-x4-sparse.dat")


@real
@pytest.mark.parametrize("name", ["freiburg-101", "aces", "intel"])
def test_keyframes_a_metre_apart_are_lost_not_mapped_wrong(name: str) -> None:
    with pytest.raises(WorkError, match="lost track at scan"):
        replay_file(DATA / f"{name}.log.gz")


def test_poses_start_at_the_origin() -> None:
    result = replay(room_recording(5), ReplaySettings(range_cap_m=4.0))
    assert result.trajectory[0] == pytest.approx(IDENTITY, abs=1e-6)
    truth = [r.reference for r in room_recording(5).records]
    assert truth[0] is not None
    assert truth[4] is not None
    assert result.trajectory[4] == pytest.approx(relative(truth[0], truth[4]), abs=0.05)
