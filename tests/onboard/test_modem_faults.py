"""A radio that fails under a runner costs datagrams, never the runner."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from imagine.mesh_comm.udp_modem import UdpModemLink


@pytest.fixture
def modem() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(3.0)
        yield opened


@pytest.fixture
def link(modem: socket.socket) -> Iterator[UdpModemLink]:
    opened = UdpModemLink(f"udpout://127.0.0.1:{modem.getsockname()[1]}")
    yield opened
    opened.close()


def test_a_datagram_that_the_system_refuses_is_counted(modem: socket.socket, link: UdpModemLink) -> None:
    link.send(bytes(70_000))  # longer than any datagram can be
    assert link.lost == 1
    modem.recv(100)  # the greeting
    link.send(b"next")
    assert modem.recv(100) == b"next"


def test_a_flood_ends_a_reading(modem: socket.socket, link: UdpModemLink, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imagine.mesh_comm.udp_modem._MOST_READS", 5)
    _, address = modem.recvfrom(100)
    for number in range(7):
        modem.sendto(bytes([number + 1]), address)
    assert [len(link.receive()), len(link.receive())] == [5, 2]


def test_a_flood_does_not_outlast_the_wait_for_a_marker(modem: socket.socket, link: UdpModemLink) -> None:
    _, address = modem.recvfrom(100)
    for _ in range(7):
        modem.sendto(b"noise", address)
    assert not link.wait_marker(1.0, 0.0)
    assert len(link.receive()) < 7
