"""The web server over real sockets: page, state, websocket, commands, and what it refuses."""

from __future__ import annotations

import base64
import http.client
import json
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from imagine.core.errors import InputError
from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.raster import TILE
from imagine.gcs.belief import BeliefTiles
from imagine.gcs.fleet import Fleet
from imagine.gcs.server import GroundServer
from imagine.gcs.snapshot import FleetEvent, FleetSnapshot, MapView
from imagine.gcs.station import obey
from imagine.gcs.wire import CommandRequest
from imagine.mesh_comm.node import MeshSettings
from imagine.mesh_comm.seal import Sealer

client = pytest.importorskip("websockets.sync.client", reason="the gcs extra is not installed")
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402

DEADLINE_S = 10.0


def snapshot(view: MapView | None = None, events: tuple[FleetEvent, ...] = ()) -> FleetSnapshot:
    return FleetSnapshot(1.0, 1.0, (), view or MapView(), (), 0.25, events)


def tile(evidence: EvidenceMap, column: int, version: int, value: int) -> None:
    evidence.merge_tile(1, TileKey(column, 0), version, np.full((TILE, TILE), value, np.int8))


@pytest.fixture
def server() -> Iterator[GroundServer]:
    with GroundServer(port=0) as running:
        yield running


def address(server: GroundServer) -> str:
    return server.url.removeprefix("http://").rstrip("/")


def get(server: GroundServer, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection(address(server), timeout=DEADLINE_S)
    try:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()
    finally:
        connection.close()


def receive_until(page: Any, wanted: Callable[[dict[str, Any]], bool]) -> list[dict[str, Any]]:
    """Return the messages up to the first wanted one."""
    seen: list[dict[str, Any]] = []
    end = time.monotonic() + DEADLINE_S
    while not seen or not wanted(seen[-1]):
        seen.append(json.loads(page.recv(timeout=max(0.0, end - time.monotonic()))))
    return seen


def answer(page: Any) -> dict[str, Any]:
    """Return the next answer to a command, past the states in between."""
    return receive_until(page, lambda message: "accepted" in message or "refused" in message)[-1]


def take(server: GroundServer) -> list[CommandRequest]:
    end = time.monotonic() + DEADLINE_S
    while not (requests := server.take_requests()):
        assert time.monotonic() < end, "no request came"
        threading.Event().wait(0.01)
    return requests


@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("/", "text/html"),
        *((f"/{name}.js", "text/javascript") for name in ("app", "map", "cards", "link")),
        ("/style.css", "text/css"),
        ("/icon.svg", "image/svg+xml"),
    ],
)
def test_serves_the_page_and_its_assets_with_a_policy_that_forbids_foreign_ones(
    server: GroundServer, path: str, kind: str
) -> None:
    status, headers, content = get(server, path)
    assert status == 200
    assert headers["content-type"].startswith(kind)
    assert "default-src 'none'" in headers["content-security-policy"]
    assert content.strip()
    for word in (b"https://", b"//cdn", b'src="http', b"@import"):
        assert word not in content


@pytest.mark.parametrize("path", ["/server.py", "/../server.py", "/%2e%2e/server.py", "/web/app.js", "/nothing"])
def test_serves_nothing_else(server: GroundServer, path: str) -> None:
    assert get(server, path)[0] == 404


def test_state_is_null_before_the_first_snapshot_and_json_after(server: GroundServer) -> None:
    assert json.loads(get(server, "/api/state")[2]) is None
    evidence = EvidenceMap(own=0)
    tile(evidence, 0, 1, -4)
    server.publish(snapshot(BeliefTiles().view(evidence)))
    state = json.loads(get(server, "/api/state")[2])
    assert (state["coverage"], state["map"]["known_cells"], state["map"]["tiles"]) == (0.25, TILE * TILE, [])
    ((column, row, cells),) = json.loads(get(server, "/api/state?map_since=0")[2])["map"]["tiles"]
    assert (column, row) == (0, 0)
    assert np.frombuffer(base64.b64decode(cells), np.int8).tolist() == [-4] * TILE * TILE


def test_websocket_sends_each_tile_and_event_once(server: GroundServer) -> None:
    evidence, tiles = EvidenceMap(own=0), BeliefTiles()
    first, second = FleetEvent(1, 0.0, 1, "info", "one"), FleetEvent(2, 1.0, 1, "info", "two")
    tile(evidence, 0, 1, -4)
    server.publish(snapshot(tiles.view(evidence), (first,)))
    with client.connect(f"ws://{address(server)}/ws") as page:
        seen = receive_until(page, lambda state: "map" in state and state["map"]["version"] == 1)
        tile(evidence, 1, 1, 4)
        server.publish(snapshot(tiles.view(evidence), (first, second)))
        seen += receive_until(page, lambda state: "map" in state and state["map"]["version"] == 2)
        seen += [json.loads(page.recv(timeout=DEADLINE_S))]
    assert [t[:2] for state in seen for t in state["map"]["tiles"]] == [[0, 0], [1, 0]]
    assert [event["text"] for state in seen for event in state["events"]] == ["one", "two"]
    with client.connect(f"ws://{address(server)}/ws") as page:  # a new page gets everything
        state = receive_until(page, lambda state: True)[0]
    assert len(state["map"]["tiles"]) == 2
    assert len(state["events"]) == 2


def test_commands_arrive_in_order_and_nonsense_is_refused(server: GroundServer) -> None:
    with client.connect(f"ws://{address(server)}/ws") as page:
        for text in ('{"command":"hold"}', '{"command":"fly"}', "nonsense", '{"command":"land","target":-1}',
                     '{"command":"land","extra":1}', "x" * 2000, '{"command":"land","target":2}'):  # fmt: skip
            page.send(text)
        answers = [answer(page) for _ in range(7)]
    assert [next(iter(a)) for a in answers] == ["accepted", *["refused"] * 5, "accepted"]
    assert take(server) == [CommandRequest("hold"), CommandRequest("land", 2)]


def test_requests_nobody_takes_are_refused_not_piled_up(server: GroundServer) -> None:
    with client.connect(f"ws://{address(server)}/ws") as page:
        for _ in range(80):
            page.send('{"command":"hold"}')
        answers = [answer(page) for _ in range(80)]
    assert sum("refused" in a for a in answers) == 80 - len(server.take_requests())
    assert "refused" in answers[-1]


def test_requests_the_fleet_cannot_follow_are_dropped(server: GroundServer, caplog: pytest.LogCaptureFixture) -> None:
    fleet = Fleet(MeshSettings(), Sealer(bytes(32), 0, 1))
    with client.connect(f"ws://{address(server)}/ws") as page:
        page.send('{"command":"hold","target":7}')
        assert "accepted" in answer(page)
    obey(fleet, server, 1.0)
    assert "known drones are none" in caplog.text
    assert fleet.snapshot(1.0).command is None


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:1", "null"])
def test_a_websocket_of_another_origin_is_refused(server: GroundServer, origin: str) -> None:
    with (
        pytest.raises((InvalidStatus, ConnectionClosed)) as refusal,
        client.connect(f"ws://{address(server)}/ws", origin=origin) as page,
    ):
        page.recv(timeout=DEADLINE_S)
    assert "403" in str(refusal.value)


def test_the_page_s_own_origin_is_welcome(server: GroundServer) -> None:
    server.publish(snapshot())
    with client.connect(f"ws://{address(server)}/ws", origin=server.url.rstrip("/")) as page:
        assert json.loads(page.recv(timeout=DEADLINE_S))["coverage"] == 0.25


def test_a_name_bent_to_this_machine_by_dns_is_refused(server: GroundServer) -> None:
    port = int(address(server).split(":")[1])
    assert get(server, "/api/state", Host=f"evil.example:{port}")[0] == 403
    assert get(server, "/api/state", Host=f"localhost:{port}")[0] == 200
    raw = socket.create_connection(("127.0.0.1", port), timeout=DEADLINE_S)
    with pytest.raises(InvalidStatus, match="403"):
        client.connect(f"ws://evil.example:{port}/ws", sock=raw, origin=f"http://evil.example:{port}")
    raw.close()


def test_a_port_in_use_is_named_with_the_remedy(server: GroundServer) -> None:
    port = int(address(server).split(":")[1])
    with pytest.raises(InputError, match=rf"port {port}.*--port"):
        GroundServer(port=port).start()


@pytest.mark.parametrize(("host", "port"), [("203.0.113.1", 0), ("127.0.0.1", 70000), ("no such host", 0)])
def test_an_address_that_cannot_be_taken_is_an_input_error(host: str, port: int) -> None:
    with pytest.raises(InputError, match="--port"):
        GroundServer(host, port).start()


def test_stops_with_pages_open_and_frees_its_port() -> None:
    server = GroundServer(port=0)
    server.start()
    port = int(address(server).split(":")[1])
    server.publish(snapshot())
    with client.connect(f"ws://{address(server)}/ws") as page:
        page.recv(timeout=DEADLINE_S)
        begin = time.monotonic()
        server.stop()
        assert time.monotonic() - begin < 4.0
        with pytest.raises(ConnectionClosed):
            receive_until(page, lambda state: False)
    server.stop()  # a second time does nothing
    with GroundServer(port=port) as again:
        assert get(again, "/")[0] == 200


def test_without_the_web_libraries_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "uvicorn", None)  # what an import of a package that is not installed meets
    with pytest.raises(InputError, match=r"pip install imagine-swarm\[gcs\]"):
        GroundServer(port=0).start()
