"""The radio port over real sockets on this machine, and in memory."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator

import pytest

from imagine.core.errors import InputError
from imagine.mesh_comm.links import (
    HELLO,
    MeshLink,
    UdpBroadcastLink,
    UdpModemLink,
    VirtualAir,
    open_link,
)
from imagine.mesh_comm.markers import encode_marker


def poll_until(condition: Callable[[], bool], timeout_s: float = 3.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "nothing came in time"


@pytest.fixture
def modem() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(3.0)
        yield opened


def connect(modem: socket.socket) -> tuple[UdpModemLink, tuple[str, int]]:
    link = UdpModemLink(f"udpout://127.0.0.1:{modem.getsockname()[1]}")
    hello, address = modem.recvfrom(2000)
    assert hello == HELLO
    return link, address


def test_the_modem_learns_the_address_and_carries_datagrams_both_ways(modem: socket.socket) -> None:
    link, address = connect(modem)
    link.send(b"out")
    assert modem.recv(2000) == b"out"
    modem.sendto(b"in", address)
    heard: list[bytes] = []
    poll_until(lambda: bool(heard.extend(link.receive()) or heard))
    assert heard == [b"in"]
    link.close()


def test_lockstep_gives_what_came_before_the_marker_and_keeps_the_rest(modem: socket.socket) -> None:
    link, address = connect(modem)
    for datagram in (b"one", b"two", encode_marker(0.1), b"three", encode_marker(0.2)):
        modem.sendto(datagram, address)
    assert link.wait_marker(0.1, 3.0)
    assert link.receive() == [b"one", b"two"]
    assert link.receive() == []
    assert link.wait_marker(0.2, 3.0)
    assert link.receive() == [b"three"]
    assert not link.wait_marker(0.3, 0.01)
    link.send_marker(0.2)
    assert modem.recv(2000) == encode_marker(0.2)
    link.close()


def test_a_modem_that_starts_late_is_greeted_again() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as late:
        late.bind(("127.0.0.1", 0))
        port = late.getsockname()[1]
    link = UdpModemLink(f"udpout://127.0.0.1:{port}")  # nobody listens: the hello is lost
    assert not link.wait_marker(0.0, 0.02)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as late:
        late.bind(("127.0.0.1", port))
        late.setblocking(False)
        answered = False

        def greeted() -> bool:
            nonlocal answered
            link.receive()
            try:
                datagram, address = late.recvfrom(2000)
            except BlockingIOError:
                return False
            late.sendto(encode_marker(0.0), address)
            answered = datagram == HELLO
            return answered

        poll_until(greeted)
        assert link.wait_marker(0.0, 3.0)
    link.close()


def test_broadcast_reaches_everyone_on_the_port(modem: socket.socket) -> None:
    port = modem.getsockname()[1]
    modem.close()  # its port is free now
    a, b = (UdpBroadcastLink(f"udpbcast://127.255.255.255:{port}") for _ in range(2))
    a.send(b"to all")
    heard: list[bytes] = []
    poll_until(lambda: bool(heard.extend(b.receive()) or heard))
    assert heard == [b"to all"]
    a.close()
    b.close()


def test_a_port_in_use_is_named(modem: socket.socket) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("", 0))
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"udpbcast://127.255.255.255:{port}"):
            UdpBroadcastLink(f"udpbcast://127.255.255.255:{port}")


@pytest.mark.parametrize(
    "url",
    ["udpout://127.0.0.1", "udpout://:5000", "udpout://127.0.0.1:99999", "udpout://127.0.0.1:x", "tcp://a:1", "radio"],
)
def test_a_wrong_address_is_named(url: str) -> None:
    with pytest.raises(InputError, match=url):
        open_link(url)


def test_an_unknown_host_is_named() -> None:
    with pytest.raises(InputError, match=r"nowhere\.invalid"):
        UdpModemLink("udpout://nowhere.invalid:5000")


def test_the_virtual_air_reaches_all_but_the_sender_and_the_cut_off() -> None:
    air = VirtualAir()
    links = [air.link() for _ in range(3)]
    ports: list[MeshLink] = list(links)
    air.cut.add(frozenset((0, 2)))
    ports[0].send(b"x")
    assert [port.receive() for port in ports] == [[], [b"x"], []]
    ports[1].close()
    ports[0].send(b"y")
    assert ports[1].receive() == []
