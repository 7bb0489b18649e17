"""The page in a browser: a few routes around a `Desk`."""

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from importlib.resources import files
from importlib.util import find_spec
from typing import Any

from mme_vla.errors import UserError, missing_extra, require
from mme_vla.extras.play.desk import Desk, StaleError
from mme_vla.serving.settings import is_local, listen
from mme_vla.utils import parse_json
from mme_vla.utils.style import css

log = logging.getLogger("mme_vla.play")
PAGE = {"": "index.html"} | {
    name: name for name in ("play.css", "play.js", "player.js", "icon.svg")
}
KINDS = {"html": "text/html", "css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}
MOST = 4096  # bytes of a request's body
ARRIVAL_S = 10  # seconds that headers may take, and a body
HEADERS = (
    (
        b"content-security-policy",
        b"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
        b"connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    ),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cache-control", b"no-store"),
)


def require_page() -> None:
    """Refuse to continue without the packages the page needs."""
    if find_spec("starlette") is None or find_spec("uvicorn") is None:
        raise missing_extra("The page", "play")


def make_app(desk: Desk, local: bool = True) -> Any:
    """The ASGI application; the desk begins when it starts.

    local: accept only requests that name this machine as their host, so that no foreign page a
        browser has open can reach the desk under a name of its own.
    """
    require_page()
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import JSONResponse, Response
    from starlette.routing import Route

    def refuse(status: int, reason: str) -> Response:
        return JSONResponse({"error": reason}, status)

    async def page(request: Request) -> Response:
        name = PAGE.get(request.path_params.get("name", ""))
        if name is None:
            return refuse(404, "There is nothing here.")
        content = files("mme_vla.extras.play").joinpath("page", name).read_bytes()
        if name == "play.css":
            content = css().encode() + content
        return Response(content, media_type=KINDS[name.rpartition(".")[2]])

    async def state(_: Request) -> Response:
        return JSONResponse(desk.state())

    async def frames(request: Request) -> Response:
        path_params = request.path_params
        try:
            packed = await asyncio.to_thread(
                desk.frames, path_params["session"], path_params["number"]
            )
        except StaleError as error:
            return refuse(404, str(error))
        return Response(packed, media_type="application/octet-stream")

    async def body(request: Request) -> Any:
        # A foreign page cannot send this type without a preflight request, which fails.
        if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
            raise UserError("Send JSON, as application/json.")
        content = bytearray()
        try:
            async with asyncio.timeout(ARRIVAL_S):
                async for piece in request.stream():
                    content += piece
                    require(len(content) <= MOST, f"The request is longer than {MOST} bytes.")
        except TimeoutError:
            raise UserError(f"The request did not arrive within {ARRIVAL_S} s.") from None
        return parse_json(bytes(content) or b"{}", "The request")

    async def choose(request: Request) -> Response:
        try:
            desk.choose(await body(request))
        except StaleError as error:
            return refuse(409, str(error))
        except UserError as error:
            return refuse(400, str(error))
        return JSONResponse(desk.state())

    async def proceed(request: Request) -> Response:
        try:
            await body(request)
        except UserError as error:
            return refuse(400, str(error))
        desk.proceed()
        return JSONResponse(desk.state())

    @asynccontextmanager
    async def lifespan(_: Any) -> AsyncIterator[None]:
        desk.begin()
        yield
        await asyncio.to_thread(desk.close)

    routes = [
        Route("/state", state),
        Route("/frames/{session}/{number:int}", frames),
        Route("/choose", choose, methods=["POST"]),
        Route("/next", proceed, methods=["POST"]),
        Route("/", page),
        Route("/{name}", page),
    ]
    return _guarded(Starlette(routes=routes, lifespan=lifespan), local)


def _guarded(app: Any, local: bool) -> Any:
    """Refuse foreign host names, add the headers that keep the page to itself, and hang up on
    bodies not read.
    """

    async def guarded(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http":
            return await app(scope, receive, send)

        headers = dict(scope["headers"])
        unread = (
            b"transfer-encoding" in headers
            or headers.get(b"content-length", b"0").strip(b"0") != b""
        )

        async def reading() -> Any:
            nonlocal unread
            message = await receive()
            unread = unread and bool(message.get("more_body", False))
            return message

        async def send_with_headers(message: Any) -> None:
            if message["type"] == "http.response.start":
                close = [(b"connection", b"close")] if unread else []
                message = {**message, "headers": [*message["headers"], *HEADERS, *close]}
            await send(message)

        if local and not is_local(_host_of(scope)):
            await send_with_headers(
                {
                    "type": "http.response.start",
                    "status": 421,
                    "headers": [(b"content-type", b"text/plain")],
                }
            )
            return await send_with_headers(
                {"type": "http.response.body", "body": b"This page is for this machine only.\n"}
            )
        return await app(scope, reading, send_with_headers)

    return guarded


def _host_of(scope: Any) -> str:
    named = next((value for name, value in scope["headers"] if name == b"host"), b"").decode(
        "latin-1"
    )
    if named.startswith("["):
        return named[1:].partition("]")[0]
    return named.partition(":")[0]


def make_server(desk: Desk, local: bool = True) -> Any:
    """A `uvicorn.Server`; its `run(sockets=[…])` returns after SIGINT, SIGTERM, or
    `should_exit`.
    """
    app = make_app(desk, local)
    import uvicorn
    from uvicorn.protocols.http.h11_impl import H11Protocol

    class TimedProtocol(H11Protocol):
        """HTTP/1.1 that waits `ARRIVAL_S` for the headers of a request; uvicorn's waits without
        end.
        """

        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            self._head = self.loop.call_later(ARRIVAL_S, transport.abort)

        def connection_lost(self, exc: Exception | None) -> None:
            super().connection_lost(exc)
            self._head.cancel()

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            if self.cycle is not None and not self.cycle.response_complete:
                self._head.cancel()

        def on_response_complete(self) -> None:
            super().on_response_complete()
            if self.cycle.response_complete:  # no further request has come already
                self._head = self.loop.call_later(ARRIVAL_S, self.transport.abort)

    return uvicorn.Server(
        uvicorn.Config(
            app,
            http=TimedProtocol,
            log_level="warning",
            access_log=False,
            ws="none",
            lifespan="on",
            timeout_graceful_shutdown=5,
        )
    )


def serve(desk: Desk, host: str, port: int) -> None:
    """Serve the page until Ctrl-C."""
    server = make_server(desk, is_local(host))
    with listen(host, port) as bound:
        display_host = f"[{host}]" if ":" in host else host
        if not is_local(host):
            log.warning("host=%s: every client that reaches this port can play", host)
        desk.address = f"http://{display_host}:{bound.getsockname()[1]}"
        log.info("open %s in a browser; Ctrl-C ends", desk.address)
        with suppress(KeyboardInterrupt):  # uvicorn raises it again when all is closed
            server.run(sockets=[bound])
