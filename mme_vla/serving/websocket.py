"""One websocket client, from handshake to goodbye."""

import asyncio
import logging
import time
from collections.abc import Awaitable
from contextlib import suppress
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from mme_vla.errors import UserError
from mme_vla.serving.codec import pack
from mme_vla.serving.connections import Connection
from mme_vla.serving.engine import Engine
from mme_vla.serving.http_sessions import said
from mme_vla.serving.session import Session, read_request
from mme_vla.serving.settings import ServeSettings

logger = logging.getLogger("mme_vla.serving")


class Visit:
    """Speaks first (`metadata`, packed), then answers one request after the other.

    Reading goes on while the policy computes, so that pings are answered and a client that goes is noticed.
    """

    def __init__(self, socket: WebSocket, engine: Engine, settings: ServeSettings, metadata: bytes) -> None:
        self._socket, self._engine, self._settings, self._metadata = socket, engine, settings, metadata
        self._connection: Connection = socket.state.connection
        self._peer = f"{socket.client.host}:{socket.client.port}" if socket.client else "client"
        self._coming: asyncio.Future[Any] | None = None

    async def run(self) -> None:
        """Serve until one side ends it."""
        session = Session(self._engine, self._settings)
        try:
            await self._socket.accept()
            await self._socket.send_bytes(self._metadata)
            self._rest()
            while (message := await self._next()) is not None:
                self._connection.work(busy=True)
                if not await self._serve_one(session, message):
                    return
                del message  # hundreds of megabytes that need not wait for the next request
                self._rest()
            await self._close(*self._connection.dismissed.result())
        except WebSocketDisconnect as gone:
            if gone.code == 1009:
                self._engine.stats.count("refused")
                logger.info("%s: message too large (limits.message_mib)", self._peer)
        finally:
            self._connection.work(busy=False)
            if self._coming is not None:
                self._coming.cancel()

    def _rest(self) -> None:
        self._connection.work(busy=False)
        if not self._connection.dismissed.done():
            self._connection.wait(self._settings.limits.idle_s)

    async def _next(self) -> Any:
        """The next message; None when the connection is to end."""
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
            answer = await self._while_connected(self._answer(session, message))
            await self._socket.send_bytes(pack(answer))
            return True
        except WebSocketDisconnect:
            raise
        except UserError as error:
            self._engine.stats.count("refused")
            logger.info("%s: refused: %s", self._peer, error)
            reason = said(error)
        except Exception as error:
            self._engine.stats.count("failed")
            logger.exception("%s: failed", self._peer)
            reason = said(error)
        await self._socket.send_text(reason)
        await self._close(1011, reason)
        return False

    async def _answer(self, session: Session, message: bytes) -> dict[str, Any]:
        begun = time.perf_counter()
        return await session.answer(await read_request(self._engine, self._settings, message), begun)

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
        short = reason.encode()[:120].decode(errors="ignore")  # a close frame has room for no more
        await self._socket.close(code, short)
