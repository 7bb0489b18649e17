"""Places on the server: time limits of connections, and which one is closed when the server is
full.

uvicorn parses HTTP and websockets, limits message sizes and pings. It has no time limit for
headers, which an ASGI application never sees: `timed_protocol` notes when bytes arrive, by methods
of `asyncio.Protocol` alone.
"""

import asyncio
import time
from dataclasses import dataclass, field
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

from mme_vla.serving.engine import ServerStats
from mme_vla.serving.settings import Limits

HEAD_S = 10  # seconds from a request's first byte (or the connection) to the end of its headers
CLOSE_S = 10  # seconds for a client to complete the closing handshake
MAX_UNAUTHENTICATED = 64  # connections without a request that the key allows
FULL = (
    "The server is full and this connection was silent longest; connect and begin the episode"
    " again."
)
IDLE = "This connection was silent for limits.idle_s; connect and begin the episode again."


@dataclass(eq=False)
class Connection:
    """One TCP connection.

    Attributes:
        admitted: it made a request that the key allows, and holds one of `limits.connections`
            places.
        websocket: it holds an episode of its own.
        busy: a complete request waits for its response. A connection whose body still arrives is
            not busy.
        in_head, in_request: headers arrive; they are complete, and the response is not.
        silent_since, deadline: seconds of `time.monotonic`; the connection is closed at its
            deadline unless busy.
        dismissed: code and reason with which a websocket is to be closed.
    """

    transport: asyncio.Transport
    address: Any
    admitted: bool = False
    websocket: bool = False
    busy: bool = False
    in_head: bool = True
    in_request: bool = False
    silent_since: float = field(default_factory=time.monotonic)
    deadline: float | None = None
    unsent_since: float | None = None
    dismissed: asyncio.Future[tuple[int, str]] = field(default_factory=asyncio.Future)

    @property
    def is_open(self) -> bool:
        """Whether a request, or the closing handshake of a websocket, is not complete."""
        return self.in_request or (self.websocket and not self.transport.is_closing())

    def expire_in(self, seconds: float | None) -> None:
        self.deadline = None if seconds is None else time.monotonic() + seconds

    def set_busy(self, busy: bool) -> None:
        """Note that a request is complete, or that its response is."""
        self.busy, self.silent_since = busy, time.monotonic()

    def close(self, code: int, reason: str) -> None:
        """Close a websocket with code and reason once its response is sent, and HTTP at once."""
        if not self.websocket:
            self.transport.close()
        elif not self.dismissed.done():
            self.dismissed.set_result((code, reason))
        self.expire_in(CLOSE_S)


class Connections:
    """All open connections of a server.

    Clients that have not shown the key hold no place: at most `MAX_UNAUTHENTICATED` of them are
    open, and the longest silent one is closed first. When all places are taken, the longest silent
    connection that is not busy is closed for a new client; HTTP, which holds no episode here,
    before websockets.
    """

    def __init__(self, limits: Limits, stats: ServerStats) -> None:
        self.limits, self._stats = limits, stats
        self.open: dict[
            Any, Connection
        ] = {}  # by the client's address and port, as in an ASGI scope
        self.stopping = False

    def arrive(self, transport: asyncio.Transport) -> Connection:
        unauthenticated = [
            known for known in self.open.values() if not (known.admitted or known.busy)
        ]
        if len(unauthenticated) >= MAX_UNAUTHENTICATED:
            oldest = min(unauthenticated, key=lambda known: known.silent_since)
            oldest.transport.abort()
            self.forget(oldest)
        address = tuple((transport.get_extra_info("peername") or (id(transport), 0))[:2])
        connection = self.open[address] = Connection(transport, address)
        connection.expire_in(HEAD_S)
        return connection

    def begin(self, connection: Connection, websocket: bool) -> None:
        """Note that the headers of a request are complete."""
        connection.websocket, connection.in_head, connection.in_request = websocket, False, True
        connection.expire_in(None)

    def end(self, connection: Connection) -> None:
        """Note that a response is complete; the place of a websocket is free then."""
        connection.in_request = False
        connection.set_busy(False)
        connection.expire_in(CLOSE_S if connection.websocket else self.limits.idle_s)
        if connection.websocket:
            connection.admitted = False
            self._count()

    def admit(self, connection: Connection) -> bool:
        """Give a connection a place, if there is one or one can be freed."""
        if self.stopping:
            return False
        admitted = [
            known for known in self.open.values() if known.admitted and known is not connection
        ]
        if len(admitted) >= self.limits.connections:
            silent = [known for known in admitted if not known.busy]
            if not silent:
                return False
            oldest = min(silent, key=lambda known: (known.websocket, known.silent_since))
            oldest.admitted = False
            oldest.close(1001, FULL)
            self._stats.count("let_go")
        connection.admitted = True
        self._count()
        return True

    def forget(self, connection: Connection) -> None:
        if self.open.get(connection.address) is connection:
            del self.open[connection.address]
        self._count()

    def close_idle(self, code: int, reason: str) -> None:
        """Close all connections that wait for no response; the others are closed after theirs."""
        for connection in list(self.open.values()):
            if connection.websocket or not connection.busy:
                connection.close(code, reason)

    def abort(self) -> None:
        for connection in list(self.open.values()):
            connection.transport.abort()

    async def watch(self) -> None:
        """Close connections that are silent, stalled, or do not read their responses, while the
        server runs.
        """
        limits = self.limits
        while True:
            await asyncio.sleep(min(1.0, limits.idle_s / 4, limits.send_s / 4))
            now = time.monotonic()
            for connection in list(self.open.values()):
                self._check(connection, now)

    def _check(self, connection: Connection, now: float) -> None:
        if connection.transport.get_write_buffer_size() == 0:
            connection.unsent_since = None
        elif connection.unsent_since is None:
            connection.unsent_since = now
        elif now - connection.unsent_since > self.limits.send_s:
            self._stats.count("too_slow")
            connection.transport.abort()
        if connection.deadline is None or connection.busy or now < connection.deadline:
            return
        if connection.websocket and connection.in_request and not connection.dismissed.done():
            connection.close(1001, IDLE)
        else:
            connection.transport.abort()
            self.forget(connection)

    def _count(self) -> None:
        self._stats.connections = sum(known.admitted for known in self.open.values())


def timed_protocol(connections: Connections) -> type[H11Protocol]:
    """HTTP protocol of uvicorn that adds each connection to `connections` and starts the time limit
    of headers.
    """

    class TimedProtocol(H11Protocol):
        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            self._connection = connections.arrive(transport)

        def data_received(self, data: bytes) -> None:
            connection = self._connection
            if not (connection.in_request or connection.in_head):
                connection.in_head = True
                connection.expire_in(HEAD_S)
            super().data_received(data)

        def connection_lost(self, exc: Exception | None) -> None:
            super().connection_lost(exc)
            connections.forget(self._connection)

    return TimedProtocol
