"""The vehicle's UDP link: malformed bytes are counted and dropped, whoever writes is answered."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from imagine.core.errors import InputError
from imagine.sim.sockets import bind_udp, drain, free_listen_port
from imagine.sim.vehicle_link import VehicleLink

HOST = "127.0.0.1"


@pytest.fixture
def companion() -> Iterator[socket.socket]:
    with bind_udp(HOST, 0, "companion") as bound:
        yield bound


@pytest.fixture
def link(companion: socket.socket) -> Iterator[VehicleLink]:
    opened = VehicleLink(1, companion.getsockname())
    yield opened
    opened.close()


def heartbeat(codec: mavlink.MAVLink) -> bytes:
    return bytes(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3).pack(codec))


def test_malformed_datagrams_are_counted_and_do_not_spoil_the_next(link: VehicleLink, companion: socket.socket) -> None:
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    good = heartbeat(codec)
    rng = np.random.default_rng(0)
    broken = [good[:9], good[:-1] + b"\x00", b"\xfd\xff", b"", rng.bytes(300), good[:14], b"\xfe" * 7, b"\xfd" * 200]
    for datagram in broken:
        companion.sendto(datagram, (HOST, link.port))
        companion.sendto(good, (HOST, link.port))
    messages = link.receive()
    assert [m.get_type() for m in messages] == ["HEARTBEAT"] * len(broken)
    assert link.malformed >= len(broken) - 1  # an empty datagram is nothing


def test_random_bytes_never_raise(link: VehicleLink, companion: socket.socket) -> None:
    rng = np.random.default_rng(1)
    good = heartbeat(mavlink.MAVLink(None, srcSystem=1, srcComponent=191))
    for _ in range(300):
        datagram = bytearray(good * 3)
        for at in rng.integers(0, len(datagram), size=3):
            datagram[at] = rng.integers(0, 256)
        companion.sendto(bytes(datagram), (HOST, link.port))
        link.receive()
    assert link.malformed > 0


def test_it_sends_to_its_companion_and_to_whoever_has_written_mavlink(
    link: VehicleLink, companion: socket.socket
) -> None:
    with bind_udp(HOST, 0, "station") as station, bind_udp(HOST, 0, "noise") as noise:
        noise.sendto(b"not MAVLink", (HOST, link.port))
        link.receive()
        message = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3)
        link.send([message])
        assert [len(drain(s)) for s in (companion, station, noise)] == [1, 0, 0]
        station.sendto(heartbeat(mavlink.MAVLink(None, srcSystem=255)), (HOST, link.port))
        link.receive()
        link.send([message])
        assert [len(drain(s)) for s in (companion, station, noise)] == [1, 1, 0]


def test_a_port_in_use_is_named(link: VehicleLink) -> None:
    with pytest.raises(InputError, match=f"port {link.port} .*in use"):
        VehicleLink(2, (HOST, 14541), port=link.port)


def test_listen_ports_handed_out_are_different() -> None:
    assert len({free_listen_port(HOST) for _ in range(20)}) == 20
