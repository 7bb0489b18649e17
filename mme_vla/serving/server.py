"""`PolicyServer`: one asyncio process, one port, websocket and HTTP, many clients, one policy.

uvicorn implements HTTP and websocket, limits sizes, and pings. `PolicyServer.websocket` and
`PolicyServer.infer` take a client's requests, `Session` does what they ask, and `Engine` computes.
`Places` limits how many clients there are.
"""

import asyncio
import hmac
import logging
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from typing import Any

from mme_vla.errors import UserError, missing_extra
from mme_vla.policy.base import Policy
from mme_vla.policy.identity import identify_policy
from mme_vla.processing.prompt import subgoal_kind
from mme_vla.serving.codec import pack, unpack
from mme_vla.serving.engine import Engine, ServerStats
from mme_vla.serving.requests import Request as PolicyRequest
from mme_vla.serving.requests import RequestReader
from mme_vla.serving.session import HttpSessions, NoEpisodeError, Session
from mme_vla.serving.settings import Limits, ServeSettings, listen
from mme_vla.utils import to_json

try:
    import uvicorn
    from starlette.applications import Starlette
    from starlette.datastructures import Headers
    from starlette.exceptions import HTTPException
    from starlette.requests import Request
    from starlette.responses import JSONResponse, PlainTextResponse, Response
    from starlette.routing import Route, WebSocketRoute
    from starlette.types import ASGIApp, Receive, Scope, Send
    from starlette.websockets import WebSocket, WebSocketDisconnect
except ImportError as error:
    raise missing_extra("Serving", "serve") from error

logger = logging.getLogger("mme_vla.serving")
MSGPACK = "application/msgpack"
METHODS = {
    "/healthz": "GET",
    "/metadata": "GET",
    "/stats": "GET",
    "/reset": "POST",
    "/infer": "POST",
}
OPEN = ("/healthz", "/metadata")
"""Need no key: the challenge's client requests the metadata without one."""
HEAD = 2**16  # bytes of request line and headers
BRIEF_S = 10
"""Seconds from a connection to the end of a request's headers, from the reply to a client without
the key to its next request, and for the closing handshake of a websocket.
"""
KEEP_ALIVE_S = 75  # seconds from a reply to the end of the next request's headers
MIN_BYTES_S = 2**16  # bytes a second of a body, beside limits.receive_s
MAX_IDLE_CONNECTIONS = 64  # connections that are between two requests
SMALL = 2**16  # bytes decoded on the event loop; larger messages are decoded in a thread
BUSY = "The server is full (limits.connections), and every client waits for a reply."
FULL = "The server is full and this client was silent longest; begin the episode again."
IDLE = "This connection was silent for limits.idle_s; connect and begin the episode again."
STOPPING = "The server is stopping."


class PolicyServer:
    """Serves a policy.

    Use: `await server.start()`, later `await server.stop()`; both in one event loop. Each
    connection has an episode of its own, which ends with it.

    Args:
        policy: with normalisation statistics, in eval mode, on its device.
        settings: how to serve.
        name: what metadata call the policy.
        trained: False says that its weights are fresh.
        source: where they are from.
    """

    def __init__(
        self,
        policy: Policy,
        settings: ServeSettings,
        *,
        name: str = "",
        trained: bool = True,
        source: str | None = None,
    ) -> None:
        policy.require_processor().require_stats()
        settings.check_robot(policy.embodiment, policy.require_processor().prompt_spec.past_actions)
        self.settings = settings
        self.stats = ServerStats()
        self.engine = Engine(policy, settings.max_batch, settings.flow_steps, self.stats)
        self.reader = RequestReader(policy.embodiment, settings.limits.frames)
        self.sessions = HttpSessions(self.engine, settings)
        self.places = Places(settings.limits, self.stats)
        self.metadata = _metadata(policy, settings, name, trained)
        identity = identify_policy(policy, name or None, source)
        self.metadata["identity"] = to_json(asdict(identity))
        self._decoders = ThreadPoolExecutor(2, "decode")  # more would delay the event loop

    @property
    def n_clients(self) -> int:
        """Websockets, HTTP requests in progress, and HTTP sessions between two requests."""
        return len(self.places.taken) + len(self.sessions.silent())

    async def start(self) -> None:
        begun = time.perf_counter()
        await self.engine.warm_up(self.settings.encode_chunk)
        logger.info("warmed up in %.1f s", time.perf_counter() - begun)
        bound = listen(self.settings.host, self.settings.port)
        self.engine.start()
        limits = self.settings.limits
        # No `limit_concurrency`: it would count clients without the key, who could so lock out
        # those who have it.
        config = uvicorn.Config(
            self._app(),
            http="h11",
            ws="websockets-sansio",
            ws_max_size=limits.message_bytes,
            ws_per_message_deflate=False,
            ws_ping_timeout=limits.pong_s,
            h11_max_incomplete_event_size=HEAD,
            timeout_keep_alive=KEEP_ALIVE_S,
            timeout_graceful_shutdown=1,
            lifespan="off",
            log_config=None,
            log_level=logging.CRITICAL + 1,  # failed handshakes of clients print no traceback
            access_log=False,
            proxy_headers=False,  # a session belongs to the address that connects, not to a header
            server_header=False,
            date_header=False,
        )
        config.load()
        server = self._uvicorn = uvicorn.Server(config)
        # `serve()` would take over the signals of the process.
        server.lifespan = config.lifespan_class(config)
        await server.startup(sockets=[bound])
        self.port = bound.getsockname()[1]
        loop = asyncio.get_running_loop()
        self._background = [
            loop.create_task(self._log_regularly()),
            loop.create_task(self._end_silent(server)),
        ]

    async def stop(self) -> None:
        """Refuse new clients, finish the requests that are running, close every connection with a
        reason.
        """
        self.places.stopping = True
        for task in self._background:
            task.cancel()
        server = self._uvicorn
        for listener in server.servers:
            listener.close()
        for place in self.places.waiting():
            self.places.end(place, STOPPING)
        with suppress(TimeoutError):
            async with asyncio.timeout(self.settings.limits.stop_s):
                while self.places.taken or self.places.closing:
                    await asyncio.sleep(0.02)
        await server.shutdown()
        for protocol in list(server.server_state.connections):
            protocol.transport.abort()
        self.sessions.entries.clear()
        self._decoders.shutdown(wait=False)
        await self.engine.stop()

    async def _log_regularly(self) -> None:
        before = 0
        while True:
            await asyncio.sleep(self.settings.log_every_s)
            if (total := self.stats.counts.total()) != before:
                logger.info("%s", self.stats.line(self.n_clients))
            before = total

    async def _end_silent(self, server: uvicorn.Server) -> None:
        while True:
            await asyncio.sleep(min(1.0, self.settings.limits.idle_s / 4))
            self.sessions.forget_silent()
            self.places.end_overdue(server)

    # Routes.

    def _app(self) -> ASGIApp:
        routes = [
            Route("/healthz", self.healthz),
            Route("/metadata", self.describe),
            Route("/stats", self.show_stats),
            Route("/reset", self.infer, methods=["POST"]),
            Route("/infer", self.infer, methods=["POST"]),
            WebSocketRoute("/{path:path}", self.websocket),
        ]
        refused = (HTTPException, UserError)
        app = Starlette(routes=routes, exception_handlers=dict.fromkeys(refused, self._refuse))

        async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
            """Check the key before anything of the body is read."""
            address = scope["client"]
            refusal = self._refusal(scope)
            self.places.deadlines[address] = None
            try:
                if refusal is None:
                    await app(scope, receive, send)
                else:
                    self.stats.counts["refused"] += 1
                    if scope["type"] == "http":
                        await refusal(scope, receive, send)
                    else:
                        await WebSocket(scope, receive, send).send_denial_response(refusal)
            finally:
                seconds = KEEP_ALIVE_S
                if refusal or scope["path"] in OPEN or scope["type"] == "websocket":
                    seconds = BRIEF_S
                self.places.deadlines[address] = time.monotonic() + seconds

        return guarded

    def _refusal(self, scope: Scope) -> Response | None:
        """The reply to a request that is not let in. Every wrong key takes the same time."""
        headers = Headers(scope=scope)
        path = scope["path"] if scope["type"] == "http" else None
        if "origin" in headers and path != "/healthz":
            return PlainTextResponse("Pages in a browser are not served.\n", 403)
        if path in OPEN or self.settings.api_key is None:
            return None
        sent = headers.getlist("authorization")
        scheme, _, key = (sent[0] if len(sent) == 1 else "").partition(" ")
        right = hmac.compare_digest(key.strip().encode(), self.settings.api_key.encode())
        if right and scheme.lower() == "api-key":
            return None
        return PlainTextResponse("Send the header Authorization: Api-Key <key>.\n", 401)

    async def _refuse(self, request: Request, error: Exception) -> Response:
        """The reply to a request that is wrong, or that there is no place for."""
        self.stats.counts["refused"] += 1
        if not isinstance(error, HTTPException):
            logger.info("%s: refused: %s", _client(request), error)
            status = 409 if isinstance(error, NoEpisodeError) else 400
            return PlainTextResponse(f"{error}\n", status)
        path = request.url.path
        text = error.detail
        if error.status_code == 404:
            text = f"There is no {path[:80]!r}; known: {', '.join(METHODS)}."
        elif error.status_code == 405:
            text = f"{path} takes {METHODS.get(path, 'another method')}."
        return PlainTextResponse(f"{text}\n", error.status_code, error.headers)

    # HTTP.

    async def healthz(self, _: Request) -> Response:
        return PlainTextResponse("OK\n")

    async def describe(self, _: Request) -> Response:
        return Response(pack(self.metadata), media_type=MSGPACK)

    async def show_stats(self, _: Request) -> Response:
        return JSONResponse(self.stats.snapshot(self.n_clients))

    async def infer(self, request: Request) -> Response:
        """Reply to a request of a session that begins with `reset` or `is_first_step`."""
        name = (_client(request), request.headers.get("x-session", ""))
        place = self.places.take(request.scope["client"])
        if place is None:
            raise HTTPException(503, BUSY)
        try:
            body = await self._body(request)
            if place not in self.places.taken:
                raise HTTPException(503, FULL)
            place.waiting_since = None
            begun = time.perf_counter()
            message = await self._read(body)
            del body
            # After the body nothing can come but the end of the connection.
            leaving = asyncio.ensure_future(request.receive())
            try:
                reply = await self.sessions.respond(name, message, begun, leaving.done)
            finally:
                leaving.cancel()
            return Response(pack(reply), media_type=MSGPACK)
        except (HTTPException, UserError):
            raise
        except Exception as error:
            self.stats.counts["failed"] += 1
            logger.exception("%s: failed", name[0])
            return PlainTextResponse(f"{failure_text(error)}\n", 500)
        finally:
            self.places.leave(place)

    async def _body(self, request: Request) -> bytearray:
        """The body that Content-Length announces.

        Raises:
            HTTPException: no body, of unknown length, too long, cut short, or too slow.
        """
        limits = self.settings.limits
        if "transfer-encoding" in request.headers:
            raise HTTPException(411, "Send the body in one piece, with Content-Length.")
        length = int(request.headers.get("content-length", "0"))  # digits: h11 checks that
        if length == 0:
            raise HTTPException(400, "The body is empty: send a packed request.")
        if length > limits.message_bytes:
            raise HTTPException(
                413,
                f"The message has {length} bytes; this server takes {limits.message_bytes}"
                " (limits.message_mib).",
            )
        body = bytearray()
        last = time.monotonic() + limits.receive_s + length / MIN_BYTES_S
        while len(body) < length:
            try:
                seconds = min(limits.receive_s, last - time.monotonic())
                message = await asyncio.wait_for(request.receive(), seconds)
            except TimeoutError:
                raise HTTPException(
                    408,
                    f"No byte of the body came for {limits.receive_s:g} s, or less than"
                    f" {MIN_BYTES_S} of them a second.",
                ) from None
            if message["type"] == "http.disconnect":
                raise HTTPException(400, "The body was cut short.")
            body += message["body"]
        return body

    async def _read(self, data: bytes | bytearray) -> PolicyRequest:
        """Decode and check a message; a large one beside the event loop."""
        if len(data) <= SMALL:
            return self.reader.parse(unpack(data))
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._decoders, lambda: self.reader.parse(unpack(data)))

    # Websocket.

    async def websocket(self, socket: WebSocket) -> None:
        """Give a client a place, and reply to it until one of the two closes the connection."""
        place = self.places.take(socket.scope["client"], socket)
        if place is None:
            self.stats.counts["refused"] += 1
            await socket.send_denial_response(PlainTextResponse(f"{BUSY}\n", 503))
            return
        try:
            await socket.accept()
            await self._converse(socket, place)
        except WebSocketDisconnect as gone:
            if gone.code == 1009:
                self.stats.counts["refused"] += 1
                logger.info("%s: message too large (limits.message_mib)", place.name)
        except TimeoutError:
            self.stats.counts["too_slow"] += 1
            logger.info("%s: took no reply for limits.send_s", place.name)
        finally:
            self.places.leave(place)

    async def _converse(self, socket: WebSocket, place: "Place") -> None:
        """Send the metadata, then reply to one request after the other."""
        await self._send(socket, self.metadata)
        session = Session(self.engine, self.settings)
        coming = asyncio.ensure_future(socket.receive())
        try:
            while True:
                await asyncio.wait([coming], timeout=self.settings.limits.idle_s)
                if not coming.done():
                    self.places.end(place, IDLE)
                event = await coming
                if event["type"] == "websocket.disconnect":
                    raise WebSocketDisconnect(event["code"])
                # Reading continues while the policy computes, so that a client that leaves is
                # noticed.
                coming = asyncio.ensure_future(socket.receive())
                if place not in self.places.taken:  # the client sent this before it knew
                    continue
                place.waiting_since = None
                computing = asyncio.ensure_future(self._reply(session, event, place))
                del event  # hundreds of megabytes that need not wait for the next request
                await asyncio.wait([computing, coming], return_when=asyncio.FIRST_COMPLETED)
                if not computing.done() and coming.result()["type"] == "websocket.disconnect":
                    computing.cancel()
                    raise WebSocketDisconnect(coming.result()["code"])
                reply = await computing  # another request may have come; it waits for its turn
                await self._send(socket, reply)
                if isinstance(reply, str) and not session.intact:
                    await _close(socket, 1011, reply)
                    return
                place.waiting_since = time.monotonic()
                if self.places.stopping:
                    self.places.end(place, STOPPING)
        finally:
            coming.cancel()

    async def _reply(
        self, session: Session, event: Mapping[str, Any], place: "Place"
    ) -> dict[str, Any] | str:
        """The reply to a message, or the reason why there is none.

        The connection closes after a reason, unless `session.intact`: a request that is refused
        before it changes anything costs neither the connection nor the episode.
        """
        try:
            if event.get("bytes") is None:
                raise UserError("Requests are binary msgpack messages; this one is text.")
            begun = time.perf_counter()
            return await session.respond(await self._read(event["bytes"]), begun)
        except UserError as error:
            self.stats.counts["refused"] += 1
            logger.info("%s: refused: %s", place.name, error)
            return str(error)
        except Exception as error:
            session.intact = False
            self.stats.counts["failed"] += 1
            logger.exception("%s: failed", place.name)
            return failure_text(error)

    async def _send(self, socket: WebSocket, reply: dict[str, Any] | str) -> None:
        """Send a reply, or a reason as text.

        Raises:
            TimeoutError: the client takes no replies.
        """
        async with asyncio.timeout(self.settings.limits.send_s):
            if isinstance(reply, str):
                await socket.send_text(reply)
            else:
                await socket.send_bytes(pack(reply))


@dataclass(eq=False)
class Place:
    """What a websocket, or an HTTP request with a body, takes of `limits.connections`.

    socket: a websocket, which has an episode of its own; None for HTTP.
    waiting_since: when the server began to wait for the client (`time.monotonic()`); None while
        the client waits for a reply.
    """

    address: Any
    socket: WebSocket | None = None
    waiting_since: float | None = field(default_factory=time.monotonic)

    @property
    def name(self) -> str:
        host, port = self.address
        return f"{host}:{port}"


class Places:
    """The clients that hold a place, and which connection is closed next.

    When all places are taken, the client that the server has waited for longest is closed for a
    new one: a body that arrives slowly before a websocket, which holds an episode. Connections
    between two requests hold no place. They end after a time, and the oldest of more than
    `MAX_IDLE_CONNECTIONS` at once, so that clients without the key cannot lock out the others.
    """

    def __init__(self, limits: Limits, stats: ServerStats) -> None:
        self._limits = limits
        self._stats = stats
        self.taken: list[Place] = []
        """A place that the server has ended is not among them any more."""
        self.closing: set[asyncio.Task[None]] = set()
        """Closing frames that are being sent."""
        self.stopping = False
        self.deadlines: dict[Any, float | None] = {}
        """By client address, when a connection is cut; None from the end of a request's headers to
        its reply.
        """

    def take(self, address: Any, socket: WebSocket | None = None) -> Place | None:
        """A place, or None if there is none."""
        if self.stopping:
            return None
        if len(self.taken) >= self._limits.connections:
            waiting = self.waiting()
            if not waiting:
                return None
            longest = min(
                waiting, key=lambda place: (place.socket is not None, place.waiting_since or 0.0)
            )
            self._stats.counts["let_go"] += 1
            self.end(longest, FULL)
        place = Place(address, socket)
        self.taken.append(place)
        return place

    def leave(self, place: Place) -> None:
        self.taken = [other for other in self.taken if other is not place]

    def waiting(self) -> list[Place]:
        """Places of clients that wait for no reply."""
        return [place for place in self.taken if place.waiting_since is not None]

    def end(self, place: Place, reason: str) -> None:
        """Close a websocket with the reason, and an HTTP connection without one."""
        self.leave(place)
        if place.socket is None:
            self.deadlines[place.address] = time.monotonic()
            return
        self.deadlines[place.address] = time.monotonic() + BRIEF_S
        task = asyncio.get_running_loop().create_task(_close(place.socket, 1001, reason))
        self.closing.add(task)
        task.add_done_callback(self.closing.discard)

    def end_overdue(self, server: uvicorn.Server) -> None:
        """Cut connections that are past their time."""
        now = time.monotonic()
        connections: set[Any] = server.server_state.connections
        transports = {connection.client: connection.transport for connection in connections}
        for address in list(self.deadlines):
            if address not in transports:
                del self.deadlines[address]
        for address in transports:
            self.deadlines.setdefault(address, now + BRIEF_S)
        pending = [(end, address) for address, end in self.deadlines.items() if end is not None]
        # Addresses are not compared: that of a client that left at once is None.
        pending.sort(key=lambda entry: entry[0], reverse=True)
        for number, (end, address) in enumerate(pending):
            if end < now or number >= MAX_IDLE_CONNECTIONS:
                transports[address].abort()


async def _close(socket: WebSocket, code: int, reason: str) -> None:
    short = reason.encode()[:120].decode(errors="ignore")  # a close frame takes no more
    with suppress(TimeoutError, RuntimeError, WebSocketDisconnect):  # the client has left
        async with asyncio.timeout(BRIEF_S):
            await socket.close(code, short)


def _client(request: Request) -> str:
    return request.client.host if request.client else ""


def failure_text(error: Exception) -> str:
    """What a client is told of an error that is not its own; the traceback is in the log."""
    return f"The server failed on this request ({type(error).__name__}: {str(error)[:200]})."


def _metadata(policy: Policy, settings: ServeSettings, name: str, trained: bool) -> dict[str, Any]:
    robot = policy.embodiment
    limits = settings.limits
    return {
        "server": "mme_vla",
        "version": version("mme-vla"),
        "model": name,
        "trained": trained,
        "embodiment": robot.name,
        "cameras": list(robot.camera_names),
        "memory_camera": robot.memory_camera,
        "readings": list(robot.readings),
        "state_dim": robot.state.width,
        "action_space": robot.action.answers,
        "action_dim": robot.action.width,
        "horizon": policy.horizon - policy.require_processor().samples.window + 1,
        "execute": settings.executed(robot),
        "remembers_frames": policy.memory is not None,
        "subgoal": subgoal_kind(policy),
        "schemas": ["mme_vla", "robomme_challenge"],
        "robot": to_json(robot.to_dict()),
        "max_actions": policy.info.max_actions,
        "sample_steps": settings.flow_steps or policy.info.sample_steps,
        "max_clients": limits.connections,
        "limits": {"message_bytes": limits.message_bytes, "frames": limits.frames},
    }
