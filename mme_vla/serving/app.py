"""The server's one application: a websocket at any path, and /healthz, /metadata, /stats, /reset and /infer by HTTP."""

import asyncio
import hmac
import logging
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from mme_vla.errors import UserError
from mme_vla.serving.codec import pack
from mme_vla.serving.connections import Connection, Connections
from mme_vla.serving.engine import Engine
from mme_vla.serving.http_sessions import BusyError, HttpSessions, said
from mme_vla.serving.session import NoEpisodeError, read_request
from mme_vla.serving.settings import ServeSettings
from mme_vla.serving.websocket import Visit

logger = logging.getLogger("mme_vla.serving")
MSGPACK = "application/msgpack"
METHODS = {"/healthz": "GET", "/metadata": "GET", "/stats": "GET", "/reset": "POST", "/infer": "POST"}
OPEN = ("/healthz", "/metadata")  # need no key: the challenge's client asks for the metadata without one
LINGER_S = 5  # seconds in which what is left of a refused body may come, so that the client gets to read the answer


def make_app(
    engine: Engine, settings: ServeSettings, metadata: bytes, connections: Connections, sessions: HttpSessions
) -> ASGIApp:
    """The ASGI application; to run under the protocols of `connections`.

    Args:
        metadata: packed.
    """

    async def healthz(_: Request) -> Response:
        return PlainTextResponse("OK\n")

    async def describe(_: Request) -> Response:
        return Response(metadata, media_type=MSGPACK)

    async def stats(_: Request) -> Response:
        return JSONResponse(engine.stats.snapshot())

    async def answer(request: Request) -> Response:
        name = (request.client.host if request.client else "", request.headers.get("x-session", ""))
        body = await read_body(request, settings)
        begun = time.perf_counter()
        try:
            try:
                asked = await read_request(engine, settings, body)
            except UserError:
                sessions.drop(name)
                raise
            del body
            return Response(pack(await sessions.answer(name, asked, begun)), media_type=MSGPACK)
        except NoEpisodeError as error:
            engine.stats.count("refused")
            return PlainTextResponse(f"{said(error)}\n", 409)
        except BusyError as error:
            raise HTTPException(503, said(error)) from None
        except UserError as error:
            logger.info("%s: refused: %s", name[0], error)
            raise HTTPException(400, said(error)) from None
        except Exception as error:
            engine.stats.count("failed")
            logger.exception("%s: failed", name[0])
            return PlainTextResponse(f"{said(error)}\n", 500)

    async def refuse(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        path = request.url.path
        known = {
            404: f"There is no {path[:80]!r}; known: {', '.join(METHODS)}.",
            405: f"{path} takes {METHODS.get(path, 'another method')}.",
        }
        engine.stats.count("refused")
        return PlainTextResponse(f"{known.get(error.status_code, error.detail)}\n", error.status_code, error.headers)

    async def websocket(socket: WebSocket) -> None:
        await Visit(socket, engine, settings, metadata).run()

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[dict[str, Any]]:
        yield {"connections": connections}

    handlers = {"/healthz": healthz, "/metadata": describe, "/stats": stats, "/reset": answer, "/infer": answer}
    app = Starlette(
        routes=[
            *(Route(path, handler, methods=[METHODS[path]]) for path, handler in handlers.items()),
            WebSocketRoute("/{path:path}", websocket),
        ],
        exception_handlers={HTTPException: refuse},
        lifespan=lifespan,
    )
    return Door(app, settings, connections, engine)


async def read_body(request: Request, settings: ServeSettings) -> bytearray:
    """The body that Content-Length announces.

    Raises:
        HTTPException: none, of unknown length, too long, cut short or stalled.
    """
    limits = settings.limits
    if "transfer-encoding" in request.headers:
        raise HTTPException(411, "Send the body in one piece, with Content-Length.")
    length = int(request.headers.get("content-length", "0"))  # digits: h11 sees to that
    if length == 0:
        raise HTTPException(400, "The body is empty: send a packed request.")
    if length > limits.message_bytes:
        what = f"The message has {length} bytes; this server takes {limits.message_bytes} (limits.message_mib)."
        raise HTTPException(413, what)
    body = bytearray()
    while len(body) < length:
        try:
            message = await asyncio.wait_for(request.receive(), limits.receive_s)
        except TimeoutError:
            raise HTTPException(408, f"No byte of the body came for {limits.receive_s:g} s.") from None
        if message["type"] == "http.disconnect":
            raise HTTPException(400, "The body was cut short.")
        body += message["body"]
    return body


class Door:
    """Decides who comes in before anything is read, and ends connections whose body nobody wanted."""

    def __init__(self, app: ASGIApp, settings: ServeSettings, connections: Connections, engine: Engine) -> None:
        self._app, self._settings, self._connections, self._stats = app, settings, connections, engine.stats

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer it here."""
        if scope["type"] == "lifespan":
            return await self._app(scope, receive, send)
        refusal = self._refusal(scope)
        if refusal is not None:
            self._stats.count("refused")
        if scope["type"] == "http":
            return await self._http(refusal or self._app, scope, receive, send)
        if refusal is not None:
            return await WebSocket(scope, receive, send).send_denial_response(refusal)
        try:
            await self._app(scope, receive, send)
        finally:
            self._connections.leave(scope["state"]["connection"])
        return None

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        unlocked = scope["type"] == "http" and scope["path"] in OPEN
        if "origin" in headers and not (unlocked and scope["path"] == "/healthz"):
            return PlainTextResponse("Pages in a browser are not served.\n", 403)
        if unlocked:
            return None
        given = headers.getlist("authorization")
        if not self._allowed(given[0] if len(given) == 1 else ""):
            return PlainTextResponse("Send the header Authorization: Api-Key <key>.\n", 401)
        connection: Connection = scope["state"]["connection"]
        if not self._connections.admit(connection):
            return PlainTextResponse("The server is full or stopping.\n", 503)
        return None

    def _allowed(self, authorization: str) -> bool:
        """Whether this key opens; takes the same time for every wrong one."""
        if self._settings.api_key is None:
            return True
        scheme, _, key = authorization.partition(" ")
        right = hmac.compare_digest(key.strip().encode(), self._settings.api_key.encode())
        return right and scheme.lower() == "api-key"

    async def _http(self, answer: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer; where the body was not read whole, throw the rest away for a moment and hang up."""
        headers = Headers(scope=scope)
        unread = "transfer-encoding" in headers or headers.get("content-length", "0").strip("0") != ""

        async def reading() -> Message:
            nonlocal unread
            message = await receive()
            unread = unread and bool(message.get("more_body", False))
            return message

        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start" and (unread or self._connections.stopping):
                message = {**message, "headers": [*message["headers"], (b"connection", b"close")]}
            elif message["type"] == "http.response.body" and unread and not message.get("more_body", False):
                await send({**message, "more_body": True})
                await self._throw_away(reading, lambda: unread)
                message = {"type": "http.response.body", "body": b""}
            await send(message)

        await answer(scope, reading, sending)

    async def _throw_away(self, reading: Receive, more: Any) -> None:
        try:
            async with asyncio.timeout(LINGER_S):
                while more():
                    await reading()
        except TimeoutError:
            return
