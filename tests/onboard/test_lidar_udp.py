"""Scans over a real UDP socket on the loopback."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import numpy as np
import pytest

from imagine.core.errors import InputError
from imagine.core.lidar import LD19, LidarSpec, Scan
from imagine.core.lidar_wire import encode_scan
from imagine.onboard.lidar_source import LidarSource
from imagine.onboard.lidar_udp import UdpLidarSource


class Sensor:
    """Sends datagrams to a source, as a twin or driver would."""

    def __init__(self, port: int) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(("127.0.0.1", port))

    def scan(self, stamp: float, spec: LidarSpec = LD19) -> None:
        self.socket.send(encode_scan(Scan(stamp, np.full(spec.beams, 1.0 + stamp, np.float32)), spec))


@pytest.fixture
def source() -> Iterator[UdpLidarSource]:
    source = UdpLidarSource("udpin://127.0.0.1:0", LD19)
    yield source
    source.close()


@pytest.fixture
def sensor(source: UdpLidarSource) -> Iterator[Sensor]:
    sensor = Sensor(source.port)
    yield sensor
    sensor.socket.close()


def test_scans_come_out_in_order(source: UdpLidarSource, sensor: Sensor) -> None:
    port: LidarSource = source
    for stamp in (0.1, 0.2, 0.3):
        sensor.scan(stamp)
    scans = [port.read(1.0) for _ in range(3)]
    assert [s.stamp for s in scans if s] == [0.1, 0.2, 0.3]
    assert scans[0] is not None
    np.testing.assert_allclose(scans[0].ranges, 1.1, atol=1e-3)
    assert port.read(0.0) is None


def test_a_scan_out_of_order_or_twice_is_dropped_and_counted(source: UdpLidarSource, sensor: Sensor) -> None:
    for stamp in (0.2, 0.1, 0.2, 0.3):
        sensor.scan(stamp)
    assert [s.stamp for s in (source.read(1.0), source.read(1.0)) if s] == [0.2, 0.3]
    assert source.stale == 2


def test_malformed_datagrams_are_dropped_and_counted(source: UdpLidarSource, sensor: Sensor) -> None:
    good = encode_scan(Scan(0.1, np.ones(360, np.float32)), LD19)
    for bad in (b"x", b"IMLS", good[:-1], good + b"\0", b"JUNK" + good[4:]):
        sensor.socket.send(bad)
    sensor.scan(0.5, LidarSpec(180))
    sensor.scan(0.6)
    scan = source.read(1.0)
    assert scan is not None
    assert scan.stamp == 0.6
    assert source.malformed == 6


def test_only_malformed_datagrams_end_in_none(source: UdpLidarSource, sensor: Sensor) -> None:
    sensor.socket.send(b"noise")
    assert source.read(0.05) is None
    assert source.malformed == 1


def test_latest_skips_what_queued_up() -> None:
    source = UdpLidarSource("udpin://127.0.0.1:0", LD19, latest=True)
    sensor = Sensor(source.port)
    for i in range(1, 6):
        sensor.scan(float(i))
    scan = source.read(1.0)
    assert scan is not None
    assert scan.stamp == 5.0
    assert source.skipped == 4
    sensor.socket.close()
    source.close()


@pytest.fixture
def live() -> Iterator[tuple[UdpLidarSource, Sensor]]:
    """A source in real time, and its sensor."""
    source = UdpLidarSource("udpin://127.0.0.1:0", LD19, latest=True)
    sensor = Sensor(source.port)
    yield source, sensor
    sensor.socket.close()
    source.close()


def read_one(source: UdpLidarSource, sensor: Sensor, stamp: float) -> float | None:
    sensor.scan(stamp)
    scan = source.read(0.2)
    return None if scan is None else scan.stamp


def test_one_stray_stamp_far_ahead_does_not_end_the_scans(live: tuple[UdpLidarSource, Sensor]) -> None:
    source, sensor = live
    assert read_one(source, sensor, 5.0) == 5.0
    sensor.scan(1e9)
    assert read_one(source, sensor, 5.1) == 5.1
    assert source.ahead == 1


def test_in_lockstep_simulated_time_may_run_ahead_of_the_wall_but_not_leap(
    source: UdpLidarSource, sensor: Sensor
) -> None:
    for stamp in (1.0, 10.0, 21.0, 10.1):
        sensor.scan(stamp)
    assert [s.stamp for s in (source.read(1.0), source.read(1.0), source.read(1.0)) if s] == [1.0, 10.0, 10.1]
    assert source.ahead == 1


def test_a_driver_started_anew_is_followed_and_time_goes_on(live: tuple[UdpLidarSource, Sensor]) -> None:
    source, sensor = live
    assert read_one(source, sensor, 500.0) == 500.0
    for k in range(9):
        sensor.scan(0.1 * k)
    assert source.read(0.0) is None
    first = read_one(source, sensor, 0.9)
    second = read_one(source, sensor, 1.0)
    assert first is not None
    assert second is not None
    assert 500.0 < first < 501.0
    assert second - first == pytest.approx(0.1)
    assert source.stale == 9 + 1


def test_scans_repeated_over_and_over_are_no_new_driver(live: tuple[UdpLidarSource, Sensor]) -> None:
    source, sensor = live
    assert read_one(source, sensor, 500.0) == 500.0
    for _ in range(30):
        sensor.scan(499.0)
    assert source.read(0.0) is None
    assert source.stale == 30


def test_a_flood_ends_a_reading(source: UdpLidarSource, sensor: Sensor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imagine.onboard.lidar_udp._MOST_DATAGRAMS", 5)
    for _ in range(7):
        sensor.socket.send(b"noise")
    sensor.scan(0.1)
    assert source.read(10.0) is None
    assert source.malformed == 5
    scan = source.read(1.0)
    assert scan is not None
    assert source.dropped == {"lidar_malformed": 7, "lidar_stale": 0, "lidar_ahead": 0, "lidar_skipped": 0}


def test_a_port_in_use_is_an_input_error_that_names_it_and_the_remedy(source: UdpLidarSource) -> None:
    with pytest.raises(InputError, match=rf"UDP port {source.port}: .*in use.*another port"):
        UdpLidarSource(f"udpin://127.0.0.1:{source.port}", LD19)


@pytest.mark.parametrize(
    "url", ["", "udpin://", "127.0.0.1:5", "udpout://127.0.0.1:5", "udpin://h:x", "udpin://h:70000"]
)
def test_a_wrong_url_is_an_input_error_with_an_example(url: str) -> None:
    with pytest.raises(InputError, match="for example udpin://127"):
        UdpLidarSource(url, LD19)
