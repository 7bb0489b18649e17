"""The HTTP form of the protocol: /healthz, /metadata, /stats, /reset and /infer.

HTTP has no connection to tie an episode to, and the protocol no session id. The rule: one session per client address,
told apart further by the header `X-Session` where several clients share an address. A session's requests run one
after the other. It is dropped after an error, as a websocket is closed, and when it has been silent for a while.
"""

import asyncio
import hmac
import json
import logging
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace

from mme_vla.errors import UserError
from mme_vla.serving.codec import pack
from mme_vla.serving.engine import Engine
from mme_vla.serving.session import Session
from mme_vla.serving.settings import ServeSettings
from mme_vla.serving.web import (
    JSON,
    MSGPACK,
    BadRequestError,
    HttpAnswer,
    HttpRequest,
    read_body,
    read_head,
    write_answer,
)

logger = logging.getLogger("mme_vla.serving")
ROUTES = {"/healthz": "GET", "/metadata": "GET", "/stats": "GET", "/reset": "POST", "/infer": "POST"}


@dataclass
class _Kept:
    """A session. requests: those it works on or that wait for their turn; `used`: end of the last one."""

    session: Session
    requests: int = 0
    turn: asyncio.Lock = field(default_factory=asyncio.Lock)
    used: float = field(default_factory=time.monotonic)


class HttpSide:
    """Answers HTTP connections with the same sessions and engine as the websocket.

    Args:
        metadata: packed. has_room: whether another connection may come in.
    """

    def __init__(self, engine: Engine, settings: ServeSettings, metadata: bytes, has_room: Callable[[], bool]) -> None:
        self._engine, self._settings, self._stats = engine, settings, engine.stats
        self._metadata, self._has_room = metadata, has_room
        self.sessions: dict[tuple[str, str], _Kept] = {}
        self.connections: dict[asyncio.Task[None], asyncio.StreamWriter] = {}
        self._idle: set[asyncio.Task[None]] = set()
        self._stopping = False

    def allowed(self, authorization: str | None) -> bool:
        """Whether a request with this Authorization header may come in; takes the same time for every wrong key."""
        if self._settings.api_key is None:
            return True
        scheme, _, key = (authorization or "").partition(" ")
        right = hmac.compare_digest(key.strip().encode(errors="surrogateescape"), self._settings.api_key.encode())
        return right and scheme.lower() == "api-key"

    def stop(self) -> None:
        """End idle connections; those that wait for an answer end after it."""
        self._stopping = True
        for task in self._idle:
            task.cancel()

    def abort(self) -> None:
        """Cut what is left."""
        for task, writer in self.connections.items():
            writer.transport.abort()
            task.cancel()
        self.sessions.clear()

    async def forget_idle_sessions(self, every: float = 15) -> None:
        """Free the memory of sessions that have been silent for `limits.idle_s`."""
        while True:
            await asyncio.sleep(min(every, self._settings.limits.idle_s))
            oldest = time.monotonic() - self._settings.limits.idle_s
            for key, kept in list(self.sessions.items()):
                if kept.used < oldest and not kept.requests:
                    del self.sessions[key]

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One connection, request after request."""
        task = asyncio.current_task()
        assert task is not None
        counted = self._has_room()
        self._stats.connections += counted
        self.connections[task] = writer
        try:
            # Beyond the last place only the health check is answered, so that a full server still counts as alive.
            while await self._one(reader, writer, task, counted) and counted:
                pass
        except (OSError, TimeoutError, asyncio.CancelledError):
            writer.transport.abort()
        except Exception:
            logger.exception("an HTTP connection failed")
            writer.transport.abort()
        finally:
            self._stats.connections -= counted
            del self.connections[task]
            writer.close()
            with suppress(OSError, asyncio.CancelledError):
                await writer.wait_closed()

    async def _one(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, task: asyncio.Task[None], room: bool
    ) -> bool:
        """Answer one request; False ends the connection."""
        limits = self._settings.limits
        address = writer.get_extra_info("peername")
        self._idle.add(task)
        try:
            request = await asyncio.wait_for(read_head(reader, str(address[0]) if address else ""), limits.idle_s)
            self._idle.discard(task)
            if request is None:
                return False
            self._check(request, room)
            body = await read_body(reader, writer, request, limits.message_bytes, limits.receive_s)
            answer = await self._answer(replace(request, body=body))
            del body
        except BadRequestError as error:
            self._stats.count("refused")
            answer = HttpAnswer(error.status, f"{error}\n".encode(), close=True)
            request = None
        finally:
            self._idle.discard(task)
        last = request is None or request.headers.get("connection", "").lower() == "close" or self._stopping
        answer = replace(answer, close=answer.close or last)
        await write_answer(writer, answer, limits.send_s)
        if answer.status == 413:  # let the client read the answer before the connection breaks under its upload
            await _drain(reader)
        return not answer.close

    def _check(self, request: HttpRequest, room: bool) -> None:
        """Refuse what need not be read.

        Raises:
            BadRequestError: unknown path or method, a browser's page, a wrong key, no room.
        """
        if request.path not in ROUTES:
            raise BadRequestError(404, f"There is no {request.path[:80]!r}; known: {', '.join(ROUTES)}.")
        if request.method != ROUTES[request.path]:
            raise BadRequestError(405, f"{request.path} takes {ROUTES[request.path]}.")
        if request.path == "/healthz":
            return
        if "origin" in request.headers:
            raise BadRequestError(403, "Pages in a browser are not served.")
        if not self.allowed(request.headers.get("authorization")):
            raise BadRequestError(401, "Send the header Authorization: Api-Key <key>.")
        if not room:
            raise BadRequestError(503, "The server is full or stopping.")

    async def _answer(self, request: HttpRequest) -> HttpAnswer:
        if request.path == "/healthz":
            return HttpAnswer(body=b"OK\n")
        if request.path == "/metadata":
            return HttpAnswer(body=self._metadata, kind=MSGPACK)
        if request.path == "/stats":
            return HttpAnswer(body=json.dumps(self._stats.snapshot(), indent=2).encode() + b"\n", kind=JSON)
        if not request.body:
            raise BadRequestError(400, "The body is empty: send a packed request.")
        key = (request.peer, request.headers.get("x-session", ""))
        kept = self._session(key)
        kept.requests += 1
        try:
            async with kept.turn:
                return await self._work(key, kept, request)
        finally:
            kept.requests -= 1
            kept.used = time.monotonic()

    async def _work(self, key: tuple[str, str], kept: _Kept, request: HttpRequest) -> HttpAnswer:
        try:
            return HttpAnswer(body=pack(await kept.session.answer(request.body)), kind=MSGPACK)
        except UserError as error:
            self._stats.count("refused")
            logger.info("%s: refused: %s", request.peer, error)
            self._drop(key, kept)
            return HttpAnswer(400, f"{error}\n".encode())
        except Exception as error:
            self._stats.count("failed")
            logger.exception("%s: failed", request.peer)
            self._drop(key, kept)
            reason = f"The server failed on this request ({type(error).__name__}: {str(error)[:200]}).\n"
            return HttpAnswer(500, reason.encode())

    def _session(self, key: tuple[str, str]) -> _Kept:
        """The session of that name; a new one takes the place of the longest silent where there is no other."""
        if key not in self.sessions:
            if len(self.sessions) >= self._settings.limits.connections:
                silent = [name for name, kept in self.sessions.items() if not kept.requests]
                if not silent:
                    raise BadRequestError(503, f"{len(self.sessions)} sessions are at work, as many as fit here.")
                del self.sessions[min(silent, key=lambda name: self.sessions[name].used)]
            self.sessions[key] = _Kept(Session(self._engine, self._settings))
        return self.sessions[key]

    def _drop(self, key: tuple[str, str], kept: _Kept) -> None:
        # A request that waited for its turn may end after another one has begun anew under the same name.
        if self.sessions.get(key) is kept:
            del self.sessions[key]


async def _drain(reader: asyncio.StreamReader, patience: float = 5) -> None:
    with suppress(TimeoutError, OSError):
        async with asyncio.timeout(patience):
            while await reader.read(2**20):
                pass
