"""The radio port over real sockets on this machine, and in memory."""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Callable, Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st
from radio_room import make_drone

from imagine.core.errors import InputError
from imagine.core.frames import Pose
from imagine.mesh_comm.link_url import parse_link_url
from imagine.mesh_comm.links import MeshLink, VirtualAir, open_link
from imagine.mesh_comm.markers import encode_marker
from imagine.mesh_comm.messages import MAX_DATAGRAM
from imagine.mesh_comm.udp_modem import HELLO, UdpModemLink
from imagine.mesh_comm.udp_network import UdpNetworkLink
from imagine.mesh_comm.udp_sockets import interfaces


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


def free_port(family: socket.AddressFamily = socket.AF_INET) -> int:
    with socket.socket(family, socket.SOCK_DGRAM) as opened:
        opened.bind(("", 0))
        return int(opened.getsockname()[1])


@pytest.fixture
def links() -> Iterator[Callable[[str], UdpNetworkLink]]:
    opened: list[UdpNetworkLink] = []

    def make(url: str) -> UdpNetworkLink:
        opened.append(UdpNetworkLink(url))
        return opened[-1]

    yield make
    for link in opened:
        link.close()


def wait_for(link: UdpNetworkLink, count: int = 1) -> list[bytes]:
    heard: list[bytes] = []
    poll_until(lambda: bool(heard.extend(link.receive())) or len(heard) >= count)
    return heard


@pytest.mark.parametrize(
    "form",
    [
        "udpbcast://127.255.255.255:{port}",
        "udpbcast://127.255.255.255:{port}?interface=lo",
        "udpbcast://239.255.77.77:{port}?interface=lo",
    ],
)
def test_everyone_on_the_port_hears_broadcast_and_multicast(form: str, links: Callable[[str], UdpNetworkLink]) -> None:
    url = form.format(port=free_port())
    a, b, c = (links(url) for _ in range(3))
    a.send(b"to all")
    assert wait_for(b) == wait_for(c) == [b"to all"]
    assert wait_for(a) == [b"to all"]  # itself too: the seal tells an echo
    assert a.lost == 0


def test_a_group_hears_only_what_is_sent_to_it(links: Callable[[str], UdpNetworkLink]) -> None:
    port = free_port()
    ours, theirs = (links(f"udpbcast://239.255.77.{n}:{port}?interface=lo") for n in (77, 78))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(b"to the port", ("127.0.0.1", port))
    theirs.send(b"to another group")
    ours.send(b"to this group")
    assert wait_for(theirs) == [b"to another group"]
    assert wait_for(ours) == [b"to this group"]


@pytest.mark.parametrize(("host", "family"), [("127.0.0.1", socket.AF_INET), ("[::1]", socket.AF_INET6)])
def test_peers_are_spoken_to_one_by_one(
    host: str, family: socket.AddressFamily, links: Callable[[str], UdpNetworkLink]
) -> None:
    ports = [free_port(family) for _ in range(3)]
    everyone = ",".join(f"{host}:{port}" for port in ports)
    a, b, c = (links(f"udppeers://{everyone}?listen={port}") for port in ports)  # one list for all, themselves in it
    a.send(b"to all")
    assert wait_for(b) == wait_for(c) == [b"to all"]


def test_foreign_and_oversize_datagrams_do_no_harm_and_are_counted(links: Callable[[str], UdpNetworkLink]) -> None:
    port = free_port()
    link = links(f"udpbcast://239.255.77.77:{port}?interface=lo")
    drone = make_drone(1)
    other = make_drone(2)
    other.fly(Pose(0.0, 0.0, 0.0), 0.0)
    foreign = [b"", b"M-SEARCH * HTTP/1.1", bytes(MAX_DATAGRAM), b"\xa7M" + bytes(40)]
    true = other.poll(0.0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        for datagram in (*foreign, bytes(MAX_DATAGRAM + 1), bytes(60_000), *true):
            stranger.sendto(datagram, ("239.255.77.77", port))
    for datagram in wait_for(link, len(foreign) + len(true)):
        drone.node.receive(datagram, 0.1)
    assert link.oversize == 2
    assert drone.node.stats == {"magic": 1, "short": 2, "version": 1}
    assert drone.node.peers(0.1)[2].is_live


def test_a_flood_is_read_in_portions_and_what_waits_is_bounded(
    links: Callable[[str], UdpNetworkLink], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("imagine.mesh_comm.udp_network._MOST_READS", 5)
    link = links(f"udpbcast://239.255.77.77:{free_port()}?interface=lo")
    for number in range(7):
        link.send(bytes((number,)))
    assert [len(link.receive()), len(link.receive())] == [5, 2]
    air = VirtualAir()
    a, b = air.link(), air.link()
    for number in range(3000):
        a.send(number.to_bytes(2))
    arrived = b.receive()
    assert (len(arrived), arrived[-1]) == (2048, (2999).to_bytes(2))


def test_a_network_that_refuses_costs_datagrams_not_the_node(links: Callable[[str], UdpNetworkLink]) -> None:
    link = links(f"udpbcast://239.255.77.77:{free_port()}?interface=lo")
    link.send(bytes(70_000))
    assert link.lost == 1
    link.send(b"next")
    assert wait_for(link) == [b"next"]


def test_a_port_in_use_is_named() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("", 0))
        port = taken.getsockname()[1]
        for url in (f"udpbcast://127.255.255.255:{port}", f"udppeers://127.0.0.1:9?listen={port}"):
            with pytest.raises(InputError, match=f"port {port}.*in use"):
                UdpNetworkLink(url)


def test_an_unknown_interface_is_named_with_those_there_are() -> None:
    for scheme in ("udpout://127.0.0.1", "udpbcast://239.255.77.77", "udppeers://127.0.0.1", "udpbcast://[ff02::1]"):
        with pytest.raises(InputError, match=f"no interface 'warp0'.*{'.*'.join(interfaces())}"):
            open_link(f"{scheme}:5000?interface=warp0")


def test_an_address_that_every_interface_has_asks_for_one() -> None:
    with pytest.raises(InputError, match=r"every interface.*interface=NAME.*lo"):
        UdpNetworkLink("udpbcast://[ff02::4d:31]:5000")


@pytest.mark.parametrize(
    "url",
    [
        "udpout://127.0.0.1", "udpout://:5000", "udpout://127.0.0.1:99999", "udpout://127.0.0.1:x", "tcp://a:1",
        "radio", "udpout://", "udpout://[::1", "udpbcast://a:1,b:2", "udppeers://127.0.0.1:1,", "udpout://u@a:1",
        "udpbcast://239.1.1.1:5?interface=", "udpbcast://239.1.1.1:5?iface=lo", "udpbcast://239.1.1.1:5?listen=7",
        "udppeers://127.0.0.1:5?listen=0", "udppeers://127.0.0.1:5?listen=x", "udpbcast://239.1.1.1:5?interface=a&interface=b",
        "udpbcast://239.1.1.1:5?lo", "udppeers://127.0.0.1:5,[::1]:5", "udpbcast://[::1]:5", "udpout://a:5/path",
        "udppeers://" + ",".join(["127.0.0.1:5"] * 65), "udpout://" + "x" * 300 + ":5",
    ],
)  # fmt: skip
def test_a_wrong_address_is_named(url: str) -> None:
    with pytest.raises(InputError, match="^" + re.escape(url)):
        open_link(url)


@given(st.text(max_size=40))
def test_no_url_breaks_more_than_itself(text: str) -> None:
    with pytest.raises(InputError):
        parse_link_url(f"udpbcast://{text}:0")


def test_an_ipv6_address_may_carry_its_interface() -> None:
    url = parse_link_url("udpbcast://[ff02::4d:31%25wlan0]:5000")
    assert (url.targets, url.interface) == ((("ff02::4d:31", 5000),), "wlan0")
    with pytest.raises(InputError, match="several interfaces: eth0, wlan0"):
        parse_link_url("udpbcast://[ff02::4d:31%25wlan0]:5000?interface=eth0")


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
