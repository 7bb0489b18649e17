"""`PolicyServer`: one asyncio process, one port, websocket and HTTP, many clients, one policy."""

import asyncio
import logging
import time
from collections.abc import Awaitable
from contextlib import suppress
from importlib.metadata import version
from typing import Any, cast

from mme_vla.errors import UserError
from mme_vla.policy.mme import MMEPolicy
from mme_vla.serving.codec import pack
from mme_vla.serving.counters import ServerStats
from mme_vla.serving.engine import Engine
from mme_vla.serving.http_side import HttpSide
from mme_vla.serving.session import Session, subgoal_kind
from mme_vla.serving.settings import ServeSettings
from mme_vla.serving.warmup import warm_up
from mme_vla.serving.web import Door

try:
    from websockets.asyncio.server import ServerConnection, serve
    from websockets.exceptions import ConnectionClosed
    from websockets.http11 import Request as Handshake
    from websockets.http11 import Response
except ImportError as error:
    raise UserError("Serving needs msgpack and websockets: pip install 'mme-vla[serve]'.") from error

logger = logging.getLogger("mme_vla.serving")
STOPPING = "The server is stopping."


class PolicyServer:
    """Serves a policy.

    Use: `await server.start()`, later `await server.stop()`; both in one event loop. Each connection has an episode of
    its own, which ends with it.

    Args:
        policy: with normalisation statistics, in eval mode, on its device.
        settings: how to serve.
        name: what metadata call the policy. trained: False says that its weights are fresh.
    """

    def __init__(self, policy: MMEPolicy, settings: ServeSettings, *, name: str = "", trained: bool = True) -> None:
        policy.require_processor().require_stats()
        settings.check_robot(policy.embodiment, policy.require_processor().prompt_format.past_actions)
        self.settings, self.stats = settings, ServerStats()
        self.engine = Engine(policy, settings.max_batch, settings.flow_steps, self.stats)
        self.metadata = _metadata(policy, settings, name, trained)
        self.port = settings.port
        self._packed_metadata = pack(self.metadata)
        self._clients: set[ServerConnection] = set()
        self._busy: set[ServerConnection] = set()
        self._stopping = False
        self._background: set[asyncio.Task[Any]] = set()
        self._http = HttpSide(self.engine, settings, self._packed_metadata, self._has_room)

    async def start(self) -> None:
        """Warm up, then accept clients.

        Raises:
            UserError: the port is taken, or the address is not one of this machine.
        """
        begun = time.perf_counter()
        await self.engine.call(lambda: warm_up(self.engine.policy, self.settings))
        logger.info("warmed up in %.1f s", time.perf_counter() - begun)
        self.engine.start()
        limits = self.settings.limits
        quiet = logging.getLogger("mme_vla.serving.handshakes")
        quiet.setLevel(logging.CRITICAL)  # a failed handshake is the client's affair, not worth a traceback

        def door(*args: Any, **options: Any) -> Any:  # called like the class it stands in for
            return Door(lambda: ServerConnection(*args, **options), self._http.serve)

        try:
            self._listener = await serve(
                self._websocket,
                self.settings.host,
                self.settings.port,
                origins=[None],  # a page in somebody's browser must not drive the policy
                compression=None,
                process_request=self._admit,
                ping_timeout=limits.receive_s,
                max_size=limits.message_bytes,
                max_queue=1,
                logger=quiet,
                create_connection=cast(Any, door),
            )
        except OSError as error:
            await self.engine.stop()
            place = f"{self.settings.host}:{self.settings.port}"
            raise UserError(
                f"Cannot listen on {place}: {error.strerror or error}. Choose another host= or port=."
            ) from None
        self.port = next(iter(self._listener.sockets)).getsockname()[1]
        self._keep(self._log_regularly())
        self._keep(self._http.forget_idle_sessions())

    async def stop(self) -> None:
        """Accept nobody, finish the requests that are running, close every connection with a reason."""
        self._stopping = True
        self._listener.close(close_connections=False)
        for task in self._background:
            task.cancel()
        closing = [self._close(ws, 1001, STOPPING) for ws in self._clients - self._busy]
        self._http.stop()
        with suppress(TimeoutError):
            async with asyncio.timeout(self.settings.limits.stop_s):
                await asyncio.gather(*closing)
                while self._clients or self._http.connections:
                    await asyncio.sleep(0.02)
        for ws in list(self._clients):
            ws.transport.abort()
        self._http.abort()
        await self.engine.stop()
        with suppress(TimeoutError):
            async with asyncio.timeout(1):
                await self._listener.wait_closed()

    def _has_room(self) -> bool:
        return not self._stopping and self.stats.connections < self.settings.limits.connections

    async def _admit(self, connection: ServerConnection, request: Handshake) -> Response | None:
        """Refuse a handshake, or let it pass (None)."""
        given = request.headers.get_all("Authorization")
        if not self._http.allowed(given[0] if len(given) == 1 else None):
            self.stats.count("refused")
            return connection.respond(401, "Send the header Authorization: Api-Key <key>.\n")
        if not self._has_room():
            self.stats.count("refused")
            return connection.respond(503, "The server is full or stopping.\n")
        return None

    async def _websocket(self, ws: ServerConnection) -> None:
        """One client from handshake to goodbye."""
        self._clients.add(ws)
        self.stats.connections += 1
        session = Session(self.engine, self.settings)
        try:
            await self._send(ws, self._packed_metadata)
            while not self._stopping:
                message = await ws.recv()
                self._busy.add(ws)
                if not await self._serve_one(ws, session, message):
                    return
                del message  # hundreds of megabytes that need not wait for the next request
                self._busy.discard(ws)
            await self._close(ws, 1001, STOPPING)
        except ConnectionClosed as gone:
            if gone.sent is not None and gone.sent.code == 1009:
                self.stats.count("refused")
                logger.info("%s: message too large (limits.message_mib)", _peer(ws))
        finally:
            self._busy.discard(ws)
            self._clients.discard(ws)
            self.stats.connections -= 1

    async def _serve_one(self, ws: ServerConnection, session: Session, message: str | bytes) -> bool:
        """Answer one request; False ends the connection."""
        try:
            if isinstance(message, str):
                raise UserError("Requests are binary msgpack messages; this one is text.")
            answer = await _while_connected(ws, session.answer(message))
            if answer is not None:
                await self._send(ws, pack(answer))
            return answer is not None
        except UserError as error:
            self.stats.count("refused")
            logger.info("%s: refused: %s", _peer(ws), error)
            reason = str(error)
        except ConnectionClosed:
            raise
        except Exception as error:
            self.stats.count("failed")
            logger.exception("%s: failed", _peer(ws))
            reason = f"The server failed on this request ({type(error).__name__}: {str(error)[:200]})."
        await self._send(ws, reason)
        await self._close(ws, 1011, reason)
        return False

    async def _send(self, ws: ServerConnection, data: bytes | str) -> None:
        """Send, unless the client does not take it in time: then its connection is cut."""
        try:
            async with asyncio.timeout(self.settings.limits.send_s):
                await ws.send(data)
        except TimeoutError:
            self.stats.count("too_slow")
            logger.info("%s: took no answer for %g s; cut off", _peer(ws), self.settings.limits.send_s)
            ws.transport.abort()
            await ws.wait_closed()

    async def _close(self, ws: ServerConnection, code: int, reason: str) -> None:
        short = reason.encode()[:120].decode(errors="ignore")  # a close frame has room for no more
        await ws.close(code, short)

    def _keep(self, work: Any) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._background.add(task)
        task.add_done_callback(self._background.discard)

    async def _log_regularly(self) -> None:
        before = 0
        while True:
            await asyncio.sleep(self.settings.log_every_s)
            if (total := self.stats.counts.total()) != before:
                logger.info("%s", self.stats.line())
            before = total


async def _while_connected[T](ws: ServerConnection, work: Awaitable[T]) -> T | None:
    """The result of `work`; None, and the work given up, when the client goes first."""
    doing, gone = asyncio.ensure_future(work), asyncio.ensure_future(ws.wait_closed())
    try:
        await asyncio.wait([doing, gone], return_when=asyncio.FIRST_COMPLETED)
        return doing.result() if doing.done() else None
    finally:
        for task in (doing, gone):
            task.cancel()
        with suppress(Exception, asyncio.CancelledError):
            await doing


def _peer(ws: ServerConnection) -> str:
    address = ws.remote_address
    return f"{address[0]}:{address[1]}" if address else "client"


def _metadata(policy: MMEPolicy, settings: ServeSettings, name: str, trained: bool) -> dict[str, Any]:
    """What a client is told when it connects."""
    limits = settings.limits
    return {
        "server": "mme_vla",
        "version": version("mme-vla"),
        "model": name,
        "trained": trained,
        "embodiment": policy.embodiment.name,
        "cameras": list(policy.embodiment.camera_names),
        "memory_camera": policy.embodiment.memory_camera,
        "state_dim": policy.embodiment.state.width,
        "action_space": policy.embodiment.action.space,
        "action_dim": policy.embodiment.action.width,
        "horizon": policy.backbone.config.horizon,
        "execute": settings.executed(policy.embodiment),
        "remembers_frames": policy.memory is not None,
        "subgoal": subgoal_kind(policy),
        "schemas": ["mme_vla", "robomme_challenge"],
        "limits": {"message_bytes": limits.message_bytes, "frames": limits.frames},
    }
