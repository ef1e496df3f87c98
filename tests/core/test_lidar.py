"""LiDAR scans: hit points, teammates left out, and the datagram they travel in."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imagine.core.errors import InputError
from imagine.core.lidar import LD19, LidarSpec, Scan, mask_near, points, returns
from imagine.core.lidar_wire import decode_scan, encode_scan

FOUR = LidarSpec(beams=4, noise_std=0.0)
HALF = LidarSpec(beams=8, fov=math.pi, start=-math.pi / 2)
RANGES = st.one_of(st.floats(0.0625, 65.5, width=32), st.sampled_from([math.inf, math.nan]))


def test_beams_run_counter_clockwise_from_straight_ahead() -> None:
    scan = Scan(0.0, np.array([1.0, 2.0, 3.0, 4.0], np.float32))
    assert points(scan, FOUR) == pytest.approx(np.array([[1, 0], [0, 2], [-3, 0], [0, -4]]), abs=1e-6)


def test_only_measurable_ranges_are_returns() -> None:
    ranges = np.array([0.01, 0.05, 12.0, 12.1, np.inf, np.nan, -1.0, 5.0], np.float32)
    spec = LidarSpec(beams=8)
    found = returns(Scan(0.0, ranges), spec)
    assert found.tolist() == [False, bool(np.float32(0.05) >= 0.05), True, False, False, False, False, True]
    assert len(points(Scan(0.0, ranges), spec)) == found.sum()


@pytest.mark.parametrize(
    "wrong",
    [
        {"beams": 0},
        {"fov": 0.0},
        {"fov": 7.0},
        {"range_min": 12.0},
        {"range_min": -0.1},
        {"rate_hz": 0.0},
        {"range_max": math.nan},
        {"fov": math.nan},
    ],
)
def test_impossible_sensors_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        dataclasses.replace(LD19, **wrong)


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-7.0, 7.0), st.floats(0.3, 3.0), st.integers(0, 359))
def test_a_return_on_a_teammate_turns_invalid_and_others_stay(
    x: float, y: float, yaw: float, distance: float, beam: int
) -> None:
    ranges = np.full(360, 5.0, np.float32)
    ranges[beam] = distance
    bearing = yaw + LD19.bearings[beam]
    teammate = np.array([[x + distance * math.cos(bearing), y + distance * math.sin(bearing)]])
    masked = mask_near(ranges, LD19, (x, y, yaw), teammate, 0.25)
    assert np.isnan(masked[beam])
    assert np.isnan(masked).sum() == 1
    assert np.isfinite(ranges).all()  # what came in is not touched


def test_masking_leaves_no_return_alone() -> None:
    ranges = np.array([np.inf, np.nan, 1.0, 1.0], np.float32)
    masked = mask_near(ranges, FOUR, (0.0, 0.0, 0.0), np.array([[-1.0, 0.0]]), 0.25)
    np.testing.assert_array_equal(masked, np.array([np.inf, np.nan, np.nan, 1.0], np.float32))
    np.testing.assert_array_equal(mask_near(ranges, FOUR, (0.0, 0.0, 0.0), np.empty((0, 2)), 0.25), ranges)


@given(st.lists(RANGES, min_size=8, max_size=8), st.floats(-1e9, 1e9))
def test_a_datagram_keeps_a_scan_to_the_millimetre(values: list[float], stamp: float) -> None:
    scan = Scan(stamp, np.array(values, np.float32))
    back = decode_scan(encode_scan(scan, HALF), HALF)
    assert back.stamp == stamp
    assert back.ranges.dtype == np.float32
    np.testing.assert_array_equal(np.isnan(back.ranges), np.isnan(scan.ranges))
    np.testing.assert_array_equal(np.isinf(back.ranges), np.isinf(scan.ranges))
    finite = np.isfinite(scan.ranges)
    assert np.abs(back.ranges[finite] - scan.ranges[finite]).max(initial=0.0) <= 0.0005 + 1e-5


@given(st.lists(RANGES, min_size=8, max_size=8))
def test_sending_a_scan_on_changes_it_no_further(values: list[float]) -> None:
    once = encode_scan(Scan(1.0, np.array(values, np.float32)), HALF)
    assert encode_scan(decode_scan(once, HALF), HALF) == once


def test_impossible_ranges_do_not_turn_into_others() -> None:
    scan = Scan(0.0, np.array([-1.0, 0.0, 1e9, -np.inf], np.float32))
    back = decode_scan(encode_scan(scan, FOUR), FOUR).ranges
    assert not (back[:2] > 0.001).any()  # at most the least range there is, which no sensor's range_min lets through
    assert back[2] == pytest.approx(65.534)
    assert np.isnan(back[3])


GOOD = encode_scan(Scan(0.5, np.full(4, 1.0, np.float32)), FOUR)


@given(st.binary(max_size=60))
def test_noise_is_refused(noise: bytes) -> None:
    with pytest.raises(InputError):
        decode_scan(noise, FOUR)


@given(st.integers(0, len(GOOD) - 1))
def test_a_cut_datagram_is_refused(length: int) -> None:
    with pytest.raises(InputError):
        decode_scan(GOOD[:length], FOUR)


@given(st.integers(0, len(GOOD) - 1), st.integers(1, 255))
def test_a_flipped_byte_is_refused_or_read_as_a_scan_that_can_be_used(at: int, flip: int) -> None:
    datagram = bytearray(GOOD)
    datagram[at] ^= flip
    try:
        scan = decode_scan(bytes(datagram), FOUR)
    except InputError:
        return
    assert math.isfinite(scan.stamp)
    assert scan.ranges.shape == (4,)


@pytest.mark.parametrize(
    ("datagram", "said"),
    [
        (GOOD[:10], "shorter than its header"),
        (b"XXXX" + GOOD[4:], "starts with"),
        (GOOD[:4] + b"\x07" + GOOD[5:], "version 7"),
        (GOOD + b"\0", "does not hold its 4 beams"),
        (encode_scan(Scan(0.0, np.ones(8, np.float32)), HALF), "LiDAR sends 8 beams"),
        (encode_scan(Scan(math.nan, np.ones(4, np.float32)), FOUR), "stamp that is not finite"),
        (encode_scan(Scan(0.0, np.ones(4, np.float32)), dataclasses.replace(FOUR, start=0.5)), "from 0.500 rad"),
    ],
)
def test_the_refusal_says_why(datagram: bytes, said: str) -> None:
    with pytest.raises(InputError, match=said):
        decode_scan(datagram, FOUR)
