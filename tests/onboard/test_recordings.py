"""Every recording format: what comes out of a good file, and what a bad one is told."""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from imagine.core.errors import InputError
from imagine.core.frames import Pose
from imagine.onboard.recordings import FORMATS, open_recording
from imagine.onboard.recordings.ydlidar import on_grid

CARMEN = """# message formats defined: PARAM SYNC ODOM FLASER RLASER
PARAM robot_use_laser on nohost 0
ODOM 0 0 0.5 0 0 0 10.0 pippo 10.0
FLASER 4 1.0 0.0 81.9 2.5 7.0 8.0 0.1 7.0 8.0 0.1 10.0 pippo 10.0
ODOM 7.0 8.0 0.1 0 0 0 0 pippo 0
NEFF 10
ODOM 7.1 8.0 0.3 0 0 0 10.5 pippo 10.5
FLASER 4 1.1 2.0 3.0 2.5 7.1 8.0 3.5 7.1 8.0 3.5 10.5 pippo 10.5
"""
CSV = """# angle_min -1.0 rad, angle_increment 0.5 rad, range_min 0.020 m, range_max 5.600 m; row: stamp_s, ranges
0.0,1.0,0.0,9.0,2.0
0.1,1.1,0.0,9.0,2.1
"""
BREEZY = "".join(
    f"{212387282 + 100000 * i} 14710 29221 25178 " + "0 " * 20 + "0 1 19 20 2229 " + "1500 " * 677 + "\n"
    for i in range(3)
)
YDLIDAR = (
    "0.0, -754.3, 89.158, 0.0, 1.5, 0.0, 2.0, 0, 0, 3.0\n1.6, 0.0, 0.116, 1.0, 0.0, 2.0, 0.0, 0.0, 4.0, 5.0, 6.0\n"
)
ALL = {"carmen": CARMEN, "csv": CSV, "breezyslam": BREEZY, "ydlidar": YDLIDAR}


def write(tmp_path: Path, text: str, name: str = "recording") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", list(ALL))
@pytest.mark.parametrize("packed", [False, True], ids=["plain", "gzip"])
def test_a_format_is_told_by_its_content_whatever_the_name(tmp_path: Path, name: str, packed: bool) -> None:
    path = tmp_path / "scans.bin"
    path.write_bytes(gzip.compress(ALL[name].encode()) if packed else ALL[name].encode())
    recording = open_recording(path)
    assert len(recording.records) == len(ALL[name].splitlines()) - {"carmen": 6, "csv": 1}.get(name, 0)
    assert all(len(r.scan.ranges) == recording.spec.beams for r in recording.records)
    assert all(r.scan.ranges.dtype == np.float32 for r in recording.records)


def test_carmen_gives_ranges_bearings_and_reference(tmp_path: Path) -> None:
    recording = open_recording(write(tmp_path, CARMEN))
    first, second = recording.records
    np.testing.assert_array_equal(first.scan.ranges, np.float32([1.0, np.nan, np.inf, 2.5]))
    assert first.scan.stamp == 10.0
    assert first.reference == Pose(7.0, 8.0, 0.1)
    assert second.reference is not None
    assert second.reference.yaw == pytest.approx(3.5 - 2 * math.pi)
    assert np.degrees(recording.spec.bearings) == pytest.approx([-90, -45, 0, 45])
    assert recording.spec.rate_hz == pytest.approx(2.0)


def test_carmen_yaw_prior_is_the_wheels_alone_without_the_map_builders_corrections(tmp_path: Path) -> None:
    first, second = open_recording(write(tmp_path, CARMEN)).records
    assert first.yaw_prior is not None
    assert second.yaw_prior is not None
    # the line with stamp 0 sets the odometry back to the corrected 0.1; the wheels then turned from 0.1 to 0.3
    assert second.yaw_prior - first.yaw_prior == pytest.approx(0.2)


def test_breezyslam_is_millimetres_and_microseconds_and_low_values_are_error_codes(tmp_path: Path) -> None:
    recording = open_recording(write(tmp_path, BREEZY))
    scan = recording.records[0].scan
    assert scan.stamp == pytest.approx(212.387282)
    np.testing.assert_array_equal(scan.ranges[:6], np.float32([np.nan, np.nan, np.nan, 0.02, 2.229, 1.5]))
    assert recording.spec.rate_hz == pytest.approx(10.0)
    assert math.degrees(recording.spec.fov) == pytest.approx(240.0, abs=0.5)
    assert recording.records[0].yaw_prior is None


def test_csv_takes_its_geometry_from_the_header(tmp_path: Path) -> None:
    recording = open_recording(write(tmp_path, CSV))
    assert recording.spec.bearings == pytest.approx([-1.0, -0.5, 0.0, 0.5])
    np.testing.assert_array_equal(recording.records[0].scan.ranges, np.float32([1.0, np.nan, np.inf, 2.0]))


@given(st.lists(st.floats(0.0, 10.0), min_size=1, max_size=3000))
def test_a_turn_of_any_number_of_beams_keeps_its_nearest_returns(ranges: list[float]) -> None:
    values = np.array(ranges)
    grid = on_grid(values, 720)
    assert grid.shape == (720,)
    kept = grid[np.isfinite(grid)]
    assert np.isin(kept, values[values > 0].astype(np.float32)).all()
    if (values > 0).any():
        assert kept.min() == np.float32(values[values > 0].min())
    else:
        assert len(kept) == 0


@pytest.mark.parametrize("name", list(ALL))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(keep=st.floats(0.0, 0.999))
def test_a_gzip_cut_anywhere_is_refused(tmp_path: Path, name: str, keep: float) -> None:
    packed = gzip.compress(ALL[name].encode())
    path = tmp_path / "cut.gz"
    path.write_bytes(packed[: int(len(packed) * keep)])
    with pytest.raises(InputError, match=r"cut\.gz"):
        open_recording(path)


@pytest.mark.parametrize("name", ["csv", "breezyslam", "ydlidar"])
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(keep=st.floats(0.5, 0.999))
def test_a_text_cut_within_a_scan_is_refused_naming_the_line(tmp_path: Path, name: str, keep: float) -> None:
    text = ALL[name][: int(len(ALL[name]) * keep)]
    if text.endswith("\n"):
        return
    with pytest.raises(InputError, match=rf"recording:{text.count(chr(10)) + 1}: "):
        open_recording(write(tmp_path, text))


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (CARMEN[: CARMEN.rindex(" 2.5")], r"recording:8: this FLASER line is cut short"),
        (CARMEN.replace("FLASER 4 1.1", "FLASER x 1.1"), r"recording:8: this FLASER line"),
        (CARMEN.replace("1.1", "1.1e"), r"recording:8: '1\.1e' is not a finite number"),
        (CARMEN.replace("1.1", "nan"), r"recording:8: 'nan' is not a finite number"),
        (CARMEN.replace(" 1.1 ", " -1.1 "), r"recording:8: a range is negative"),
        (CARMEN.replace("ODOM 7.1 8.0 0.3", "ODOM 7.1 8.0"), r"recording:7: this ODOM line has 9 fields"),
        (CARMEN.replace("FLASER 4 1.1 2.0", "FLASER 3 2.0"), r"recording:8: 3 ranges, but the first scan has 4"),
        ("\n".join(CARMEN.splitlines()[:5]) + "\n", r"holds 1 scan"),
        ("PARAM a b c d\n", r"holds 0 scan"),
        (CSV.replace("angle_increment", "step"), r"recording:1: the header gives no angle_increment"),
        (CSV + "0.2,1.0\n", r"recording:4: 1 ranges, but the first scan has 4"),
        (CSV.splitlines()[0] + "\n", r"holds 0 scan"),
        (BREEZY + "1 2 3 4\n", r"recording:4: 4 fields, expected 706"),
        (BREEZY.splitlines()[0] + "\n", r"holds 1 scan"),
        ("", r"the file is empty"),
        ("\n\n", r"the file is empty"),
        ("Dear diary,\n", r"not a LiDAR recording; known formats: CARMEN log, .*YDLIDAR"),
    ],
)
def test_a_bad_file_is_told_where_and_why(tmp_path: Path, text: str, match: str) -> None:
    with pytest.raises(InputError, match=match):
        open_recording(write(tmp_path, text))


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.onnx"
    path.write_bytes(bytes(range(128, 256)) * 40)
    with pytest.raises(InputError, match=r"model\.onnx:1: not text"):
        open_recording(path)


def test_a_damaged_gzip_is_refused(tmp_path: Path) -> None:
    packed = bytearray(gzip.compress(CARMEN.encode()))
    packed[len(packed) // 2] ^= 0xFF
    path = tmp_path / "damaged.gz"
    path.write_bytes(packed)
    with pytest.raises(InputError, match=r"damaged\.gz"):
        open_recording(path)


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        open_recording(tmp_path / "nowhere.log")
    with pytest.raises(InputError, match="cannot be read"):
        open_recording(tmp_path)


def test_format_names_are_unique() -> None:
    assert len({f.name for f in FORMATS}) == len(FORMATS) == 4
