"""The ground station's web server: the page, its websocket, and the state as JSON, in a thread of its own.

The flight's loop publishes immutable snapshots and takes the pilot's requests from a queue; nothing else is shared.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import queue
import socket
import threading
import time
from contextlib import suppress
from importlib import resources
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import urlsplit

import msgspec

from imagine.core.errors import InputError, WorkError
from imagine.gcs.cell_question import CellQuestion, cell_question
from imagine.gcs.snapshot import FleetSnapshot
from imagine.gcs.wire import ClientView, CommandRequest, decode_request, state_since

if TYPE_CHECKING:  # the web libraries are an extra: a drone runs without them
    import uvicorn
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.websockets import WebSocket

logger = logging.getLogger(__name__)
T = TypeVar("T")

PUSH_PERIOD_S = 0.2
_START_DEADLINE_S = 10.0
_STOP_DEADLINE_S = 5.0
_QUEUE_LIMIT = 64
_ANSWER_DEADLINE_S = 2.0
_WAITING = b'{"waiting":true}'
_ASSETS = {
    "": ("index.html", "text/html; charset=utf-8"),
    "index.html": ("index.html", "text/html; charset=utf-8"),
    "app.js": ("app.js", "text/javascript; charset=utf-8"),
    "map.js": ("map.js", "text/javascript; charset=utf-8"),
    "cell.js": ("cell.js", "text/javascript; charset=utf-8"),
    "cards.js": ("cards.js", "text/javascript; charset=utf-8"),
    "link.js": ("link.js", "text/javascript; charset=utf-8"),
    "style.css": ("style.css", "text/css; charset=utf-8"),
    "icon.svg": ("icon.svg", "image/svg+xml"),
}
_HEADERS = {
    # the page loads nothing from elsewhere, and may not be framed by another page that tricks the pilot into clicking
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}


class GroundServer:
    """Serves the ground station's page at `url` between `start()` and `stop()`.

    `publish` hands over the newest snapshot; `take_requests` and `take_questions` return what pilots have asked for
    since the last call.
    Port 0 takes any free port. Raises InputError if the web libraries are missing or the address cannot be taken.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 8770) -> None:
        """Prepare a server for `host` and `port`; nothing is bound before `start()`."""
        self._host, self._port = host, port
        self._snapshot: FleetSnapshot | None = None
        self._published = 0.0
        self._requests: queue.Queue[CommandRequest] = queue.Queue(_QUEUE_LIMIT)
        self._questions: queue.Queue[CellQuestion] = queue.Queue(_QUEUE_LIMIT)
        self._server: uvicorn.Server | None = None
        self._thread: threading.Thread | None = None
        self._failure: BaseException | None = None

    @property
    def url(self) -> str:
        """Address of the page, for a person."""
        host = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(self._host, self._host)
        if ":" in host and not host.startswith("["):
            host = f"[{host}]"
        return f"http://{host}:{self._port}/"

    def publish(self, snapshot: FleetSnapshot) -> None:
        """Hand over the newest snapshot; from any thread, never waits."""
        self._snapshot, self._published = snapshot, time.monotonic()

    def take_requests(self) -> list[CommandRequest]:
        """Return the commands asked for since the last call, oldest first."""
        return _drain(self._requests)

    def take_questions(self) -> list[CellQuestion]:
        """Return the cells asked about since the last call, oldest first; each waits for its answer to be set."""
        return _drain(self._questions)

    def start(self) -> None:
        """Bind the port and serve; return once the page answers. Raises InputError, or WorkError past the deadline."""
        uvicorn = _uvicorn()
        app = self.app()
        listener = self._bind()
        config = uvicorn.Config(
            app, log_config=None, access_log=False, lifespan="off", ws="websockets-sansio", ws_max_size=4096,
            ws_ping_interval=5.0, ws_ping_timeout=10.0, timeout_graceful_shutdown=1,
        )  # fmt: skip
        server = self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._serve, args=(server, listener), name="gcs-web", daemon=True)
        self._thread.start()
        deadline = time.monotonic() + _START_DEADLINE_S
        while not server.started:
            self._thread.join(0.01)
            if not self._thread.is_alive() or time.monotonic() > deadline:
                listener.close()
                raise WorkError(f"the ground station's web server did not start: {self._failure or 'no answer'}")
        if not _is_loopback(self._host):
            logger.warning("the ground station listens on %s: whoever reaches it can command the drones", self._host)

    def stop(self) -> None:
        """Close all connections and end the thread. Raises WorkError if it does not end in time."""
        if self._server is None or self._thread is None:
            return
        self._server.should_exit = True
        self._thread.join(_STOP_DEADLINE_S)
        if self._thread.is_alive():
            self._server.force_exit = True
            self._thread.join(_STOP_DEADLINE_S)
            if self._thread.is_alive():
                raise WorkError("the ground station's web server did not stop")
        self._server = self._thread = None

    def __enter__(self) -> GroundServer:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _bind(self) -> socket.socket:
        family = socket.AF_INET6 if ":" in self._host else socket.AF_INET
        listener = socket.socket(family, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((self._host.strip("[]"), self._port))
            listener.listen(128)
        except (OSError, OverflowError) as error:
            listener.close()
            reason = error.strerror if isinstance(error, OSError) else str(error)
            raise InputError(
                f"the ground station cannot listen on {self._host} port {self._port}: {reason}; "
                "choose another with --port"
            ) from error
        self._port = listener.getsockname()[1]
        return listener

    def _serve(self, server: uvicorn.Server, listener: socket.socket) -> None:
        try:
            server.run(sockets=[listener])
        except (Exception, SystemExit) as error:  # the thread's edge: start() reports it, and the log keeps it
            self._failure = error
            logger.exception("the ground station's web server failed")
        finally:
            listener.close()

    # -- the application ----------------------------------------------------------------------------------------------

    def app(self) -> Starlette:
        """Return the ASGI application: page, `/api/state`, `/api/provenance` and `/ws`."""
        _uvicorn()
        from starlette.applications import Starlette
        from starlette.routing import Route, WebSocketRoute

        # the framework reads no annotations here: it passes one request, or one websocket
        return Starlette(
            routes=[
                WebSocketRoute("/ws", self._websocket),
                Route("/api/state", self._state),
                Route("/api/provenance", self._provenance),
                Route("/{name:path}", _asset),
            ]
        )

    def _message(self, snapshot: FleetSnapshot, client: ClientView) -> bytes:
        state = state_since(snapshot, client)
        state["published_age_s"] = round(time.monotonic() - self._published, 2)
        return msgspec.json.encode(state)

    async def _state(self, request: Request) -> Response:
        from starlette.responses import Response

        if not _trusted_host(request.headers.get("host", "")):
            return Response("unknown host\n", 403)
        if self._snapshot is None:
            return Response(b"null", media_type="application/json")
        since = request.query_params.get("map_since", "")
        # without map_since the reader wants figures, not the map
        version = int(since) if since.isdecimal() else self._snapshot.map.version
        message = self._message(self._snapshot, ClientView(map_version=version))
        return Response(message, media_type="application/json", headers={"Cache-Control": "no-store"})

    async def _provenance(self, request: Request) -> Response:
        from starlette.responses import Response

        if not _trusted_host(request.headers.get("host", "")):
            return Response("unknown host\n", 403)
        try:
            question = cell_question(request.query_params)
            self._questions.put_nowait(question)
            answer = await asyncio.wait_for(asyncio.wrap_future(question.answer), _ANSWER_DEADLINE_S)
        except InputError as error:
            return Response(f"{error}\n", 400)
        except (queue.Full, TimeoutError):
            return Response("the flight's loop does not answer\n", 503)
        headers = {"Cache-Control": "no-store"}
        return Response(msgspec.json.encode(answer), media_type="application/json", headers=headers)

    async def _websocket(self, socket_: WebSocket) -> None:
        from starlette.websockets import WebSocketDisconnect

        host, origin = socket_.headers.get("host", ""), socket_.headers.get("origin")
        if not _trusted_host(host) or (origin is not None and urlsplit(origin).netloc != host):
            logger.warning("refused a websocket from origin %r to host %r", origin, host)
            await socket_.close(1008)
            return
        await socket_.accept()
        push = asyncio.create_task(self._push(socket_))
        try:
            await self._listen(socket_)
        except WebSocketDisconnect:
            pass  # the page was closed: the ordinary end
        finally:
            push.cancel()
            # a client that vanishes fails the push as well; the connection is over either way
            with suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError, OSError):
                await push

    async def _push(self, socket_: WebSocket) -> None:
        client = ClientView()
        while True:
            # a page that comes back after a restart must learn that what it shows is gone
            message = _WAITING if self._snapshot is None else self._message(self._snapshot, client)
            await socket_.send_text(message.decode())
            await asyncio.sleep(PUSH_PERIOD_S)

    async def _listen(self, socket_: WebSocket) -> None:
        while True:
            text = await socket_.receive_text()
            answer: dict[str, Any]
            try:
                request = decode_request(text)
                self._requests.put_nowait(request)
                answer = {"accepted": request.command, "target": request.target}
                logger.info("pilot asks: %s, drone %d (0: all)", request.command, request.target)
            except InputError as error:
                answer = {"refused": str(error)}
            except queue.Full:
                answer = {"refused": "too many commands are waiting: the flight's loop does not take them"}
            await socket_.send_text(msgspec.json.encode(answer).decode())


def _drain(waiting: queue.Queue[T]) -> list[T]:
    taken: list[T] = []
    with suppress(queue.Empty):
        while True:
            taken.append(waiting.get_nowait())
    return taken


async def _asset(request: Request) -> Response:
    from starlette.responses import Response

    known = _ASSETS.get(request.path_params["name"])
    if known is None:
        return Response("not found\n", 404)
    name, media_type = known
    content = resources.files("imagine.gcs").joinpath("web", name).read_bytes()
    return Response(content, media_type=media_type, headers=_HEADERS)


def _uvicorn() -> Any:
    try:
        import starlette  # noqa: F401
        import uvicorn
        import websockets  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"the ground station's page needs the package '{error.name}': pip install imagine-swarm[gcs]"
        ) from error
    return uvicorn


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def _trusted_host(header: str) -> bool:
    """Tell whether a Host header names this machine without trusting the DNS.

    A hostile site can make its own name resolve to this machine (DNS rebinding), so that its origin equals the host;
    an address, localhost or the machine's own name cannot be bent that way.
    """
    name = urlsplit(f"//{header}").hostname or ""
    if name in ("localhost", socket.gethostname().lower()):
        return True
    with suppress(ValueError):
        ipaddress.ip_address(name)
        return True
    return False
