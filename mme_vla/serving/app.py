"""The server's one application: a websocket at any path, and /healthz, /metadata, /stats, /reset
and /infer by HTTP.
"""

import asyncio
import hmac
import logging
import time
from collections.abc import Awaitable
from contextlib import suppress
from typing import Any

from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from mme_vla.errors import UserError
from mme_vla.serving.codec import pack
from mme_vla.serving.connections import Connection, Connections
from mme_vla.serving.engine import Engine
from mme_vla.serving.session import (
    BusyError,
    HttpSessions,
    NoEpisodeError,
    Session,
    error_text,
    read_request,
)
from mme_vla.serving.settings import ServeSettings

logger = logging.getLogger("mme_vla.serving")


class ServedConnection:
    """Sends `metadata` (packed), then responds to one request after the other.

    Reading continues while the policy computes, so that pings are served and a client that leaves
    is noticed.
    """

    def __init__(
        self, socket: WebSocket, engine: Engine, settings: ServeSettings, metadata: bytes
    ) -> None:
        self._socket, self._engine, self._settings, self._metadata = (
            socket,
            engine,
            settings,
            metadata,
        )
        self._connection: Connection = socket.scope["connection"]
        self._peer = f"{socket.client.host}:{socket.client.port}" if socket.client else "client"
        self._coming: asyncio.Future[Any] | None = None

    async def run(self) -> None:
        session = Session(self._engine, self._settings)
        try:
            await self._socket.accept()
            await self._socket.send_bytes(self._metadata)
            self._await_request()
            while (message := await self._next()) is not None:
                self._connection.set_busy(True)
                if not await self._serve_one(session, message):
                    return
                del message  # hundreds of megabytes that need not wait for the next request
                self._await_request()
            await self._close(*self._connection.dismissed.result())
        except WebSocketDisconnect as gone:
            if gone.code == 1009:
                self._engine.stats.count("refused")
                logger.info("%s: message too large (limits.message_mib)", self._peer)
        finally:
            self._connection.set_busy(False)
            if self._coming is not None:
                self._coming.cancel()

    def _await_request(self) -> None:
        self._connection.set_busy(False)
        if not self._connection.dismissed.done():
            self._connection.expire_in(self._settings.limits.idle_s)

    async def _next(self) -> Any:
        dismissed, coming = self._connection.dismissed, self._receiving()
        if not dismissed.done():
            await asyncio.wait([coming, dismissed], return_when=asyncio.FIRST_COMPLETED)
        if dismissed.done():
            return None
        self._coming = None
        event = coming.result()
        if event["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(event["code"])
        return event["bytes"] if event.get("bytes") is not None else event["text"]

    def _receiving(self) -> asyncio.Future[Any]:
        if self._coming is None:
            self._coming = asyncio.ensure_future(self._socket.receive())
        return self._coming

    async def _serve_one(self, session: Session, message: str | bytes) -> bool:
        """Answer one request; False ends the connection."""
        try:
            if isinstance(message, str):
                raise UserError("Requests are binary msgpack messages; this one is text.")
            reply = await self._while_connected(self._reply(session, message))
            await self._socket.send_bytes(pack(reply))
            return True
        except WebSocketDisconnect:
            raise
        except UserError as error:
            self._engine.stats.count("refused")
            logger.info("%s: refused: %s", self._peer, error)
            reason = error_text(error)
        except Exception as error:
            self._engine.stats.count("failed")
            logger.exception("%s: failed", self._peer)
            reason = error_text(error)
        await self._socket.send_text(reason)
        await self._close(1011, reason)
        return False

    async def _reply(self, session: Session, message: bytes) -> dict[str, Any]:
        begun = time.perf_counter()
        return await session.respond(
            await read_request(self._engine, self._settings, message), begun
        )

    async def _while_connected[T](self, work: Awaitable[T]) -> T:
        """The result of `work`, which is given up when the client goes first."""
        doing, coming = asyncio.ensure_future(work), self._receiving()
        try:
            await asyncio.wait([doing, coming], return_when=asyncio.FIRST_COMPLETED)
            if not doing.done() and coming.result()["type"] == "websocket.disconnect":
                raise WebSocketDisconnect(coming.result()["code"])
            return await doing  # another request may have come; it waits for its turn
        finally:
            doing.cancel()
            with suppress(Exception, asyncio.CancelledError):
                await doing

    async def _close(self, code: int, reason: str) -> None:
        short = reason.encode()[:120].decode(errors="ignore")  # a close frame takes no more
        await self._socket.close(code, short)


MSGPACK = "application/msgpack"
METHODS = {
    "/healthz": "GET",
    "/metadata": "GET",
    "/stats": "GET",
    "/reset": "POST",
    "/infer": "POST",
}
OPEN = (
    "/healthz",
    "/metadata",
)  # need no key: the challenge's client requests the metadata without one
MIN_BYTES_S = 2**16  # bytes a second of a body, beside limits.receive_s
# seconds for the remaining body of a refused request, so that the client can read the response
LINGER_S = 5


def make_app(
    engine: Engine,
    settings: ServeSettings,
    metadata: bytes,
    connections: Connections,
    sessions: HttpSessions,
) -> ASGIApp:
    """The ASGI application, under uvicorn with `timed_protocol(connections)`;
    `metadata` is packed.
    """

    async def healthz(_: Request) -> Response:
        return PlainTextResponse("OK\n")

    async def describe(_: Request) -> Response:
        return Response(metadata, media_type=MSGPACK)

    async def stats(_: Request) -> Response:
        return JSONResponse(engine.stats.snapshot())

    async def infer(request: Request) -> Response:
        name = (request.client.host if request.client else "", request.headers.get("x-session", ""))
        body = await read_body(request, settings)
        request.scope["connection"].set_busy(True)
        begun = time.perf_counter()
        try:
            try:
                parsed = await read_request(engine, settings, body)
            except UserError:
                sessions.drop(name)
                raise
            del body
            return Response(pack(await sessions.respond(name, parsed, begun)), media_type=MSGPACK)
        except NoEpisodeError as error:
            engine.stats.count("refused")
            return PlainTextResponse(f"{error_text(error)}\n", 409)
        except BusyError as error:
            raise HTTPException(503, error_text(error)) from None
        except UserError as error:
            logger.info("%s: refused: %s", name[0], error)
            raise HTTPException(400, error_text(error)) from None
        except Exception as error:
            engine.stats.count("failed")
            logger.exception("%s: failed", name[0])
            return PlainTextResponse(f"{error_text(error)}\n", 500)

    async def refuse(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        path = request.url.path
        known = {
            404: f"There is no {path[:80]!r}; known: {', '.join(METHODS)}.",
            405: f"{path} takes {METHODS.get(path, 'another method')}.",
        }
        engine.stats.count("refused")
        return PlainTextResponse(
            f"{known.get(error.status_code, error.detail)}\n", error.status_code, error.headers
        )

    async def websocket(socket: WebSocket) -> None:
        await ServedConnection(socket, engine, settings, metadata).run()

    handlers = {
        "/healthz": healthz,
        "/metadata": describe,
        "/stats": stats,
        "/reset": infer,
        "/infer": infer,
    }
    app = Starlette(
        routes=[
            *(Route(path, handler, methods=[METHODS[path]]) for path, handler in handlers.items()),
            WebSocketRoute("/{path:path}", websocket),
        ],
        exception_handlers={HTTPException: refuse},
    )
    return RequestGuard(app, settings, connections, engine)


async def read_body(request: Request, settings: ServeSettings) -> bytearray:
    """The body that Content-Length announces.

    Raises:
        HTTPException: no body, of unknown length, too long, cut short, stalled or too slow.
    """
    limits = settings.limits
    if "transfer-encoding" in request.headers:
        raise HTTPException(411, "Send the body in one piece, with Content-Length.")
    length = int(request.headers.get("content-length", "0"))  # digits: h11 checks that
    if length == 0:
        raise HTTPException(400, "The body is empty: send a packed request.")
    if length > limits.message_bytes:
        what = (
            f"The message has {length} bytes; this server takes {limits.message_bytes}"
            " (limits.message_mib)."
        )
        raise HTTPException(413, what)
    body, last = bytearray(), time.monotonic() + limits.receive_s + length / MIN_BYTES_S
    while len(body) < length:
        try:
            seconds = min(limits.receive_s, last - time.monotonic())
            message = await asyncio.wait_for(request.receive(), seconds)
        except TimeoutError:
            what = (
                f"No byte of the body came for {limits.receive_s:g} s, or less than {MIN_BYTES_S}"
                " of them a second."
            )
            raise HTTPException(408, what) from None
        if message["type"] == "http.disconnect":
            raise HTTPException(400, "The body was cut short.")
        body += message["body"]
    return body


class RequestGuard:
    """Checks key and place of a request before anything of its body is read."""

    def __init__(
        self, app: ASGIApp, settings: ServeSettings, connections: Connections, engine: Engine
    ) -> None:
        self._app, self._settings, self._connections, self._stats = (
            app,
            settings,
            connections,
            engine.stats,
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        connection = self._connections.open.get(scope.get("client"))
        if connection is None:  # a client that has left already
            return
        self._connections.begin(connection, scope["type"] == "websocket")
        scope["connection"] = connection
        try:
            if (refusal := self._refusal(scope)) is not None:
                self._stats.count("refused")
            if scope["type"] == "http":
                await self._http(refusal or self._app, scope, receive, send)
            elif refusal is not None:
                await WebSocket(scope, receive, send).send_denial_response(refusal)
            else:
                await self._app(scope, receive, send)
        finally:
            self._connections.end(connection)

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        unlocked = scope["type"] == "http" and scope["path"] in OPEN
        if "origin" in headers and not (unlocked and scope["path"] == "/healthz"):
            return PlainTextResponse("Pages in a browser are not served.\n", 403)
        if unlocked:
            return None
        tokens = headers.getlist("authorization")
        if not self._allowed(tokens[0] if len(tokens) == 1 else ""):
            return PlainTextResponse("Send the header Authorization: Api-Key <key>.\n", 401)
        if not self._connections.admit(scope["connection"]):
            return PlainTextResponse("The server is full or stopping.\n", 503)
        return None

    def _allowed(self, authorization: str) -> bool:
        """Whether the key is right; takes the same time for every wrong one."""
        if self._settings.api_key is None:
            return True
        scheme, _, key = authorization.partition(" ")
        right = hmac.compare_digest(key.strip().encode(), self._settings.api_key.encode())
        return right and scheme.lower() == "api-key"

    async def _http(self, app: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
        """Respond; after a response that precedes the end of the body, discard the body for
        `LINGER_S` and close.
        """
        headers = Headers(scope=scope)
        unread = (
            "transfer-encoding" in headers or headers.get("content-length", "0").strip("0") != ""
        )

        async def reading() -> Message:
            nonlocal unread
            message = await receive()
            unread = unread and bool(message.get("more_body", False))
            return message

        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start" and (unread or self._connections.stopping):
                message = {**message, "headers": [*message["headers"], (b"connection", b"close")]}
            elif message["type"] == "http.response.body" and unread:
                await send({**message, "more_body": True})
                with suppress(TimeoutError):
                    async with asyncio.timeout(LINGER_S):
                        while unread:
                            await reading()
                message = {"type": "http.response.body", "body": b""}
            await send(message)

        await app(scope, reading, sending)
