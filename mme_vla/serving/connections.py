"""Who is connected: how long each connection may stay silent, and which one goes where there are too many.

The two classes at the end are uvicorn's protocols. They add what uvicorn leaves open: a time limit for headers and for
messages that stall, and a connection's own record, which the application finds in its scope.
"""

import asyncio
import time
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from mme_vla.serving.engine import ServerStats
from mme_vla.serving.settings import Limits

HEAD_S = 10  # seconds from a request's first byte (or the connection) to the end of its headers
GOODBYE_S = 10  # seconds a client gets to answer a goodbye
MAX_UNAUTHENTICATED = 64  # most connections that have not yet made a request the key allows
MOST_PIECES = 2**16  # most frames one websocket message may be cut into
FULL = "The server is full and this connection was silent longest; connect and begin the episode again."
IDLE = "This connection was silent for limits.idle_s; connect and begin the episode again."


class Connection:
    """One connection, whatever is spoken on it.

    Attributes:
        guest: it made a request that the key allows, and so holds one of `limits.connections` places.
        websocket: it holds an episode of its own.
        busy: it waits for an answer.
        silent_since: when its last request was answered, or when it came.
        dismissed: done once the connection is to end, with the code and the reason to tell a websocket client.
    """

    def __init__(self, transport: asyncio.Transport) -> None:
        self.transport = transport
        self.admitted = self.websocket = self.busy = False
        self.silent_since = time.monotonic()
        self.dismissed: asyncio.Future[tuple[int, str]] = asyncio.get_running_loop().create_future()
        self.until: float | None = None
        self.unsent_since: float | None = None

    def wait(self, seconds: float | None) -> None:
        """Give it so many seconds from now on; None: as long as it takes."""
        self.until = None if seconds is None else time.monotonic() + seconds

    def work(self, busy: bool) -> None:
        """Note that a request begins, or that it is answered."""
        self.busy, self.silent_since = busy, time.monotonic()

    def close(self, code: int, reason: str) -> None:
        """End it as soon as nothing is being answered: a websocket with a goodbye, HTTP at once."""
        if not self.websocket:
            self.transport.close()
        elif not self.dismissed.done():
            self.dismissed.set_result((code, reason))
        self.wait(GOODBYE_S)


class Connections:
    """All open connections of a server.

    Connections of untrusted sources never take a place from those who have shown the key: they have `STRANGERS` places
    of their own, and the longest silent one goes first. Among the guests, the longest silent connection that waits for
    no answer makes room for a new one; one that holds no episode goes before one that does.
    """

    def __init__(self, limits: Limits, stats: ServerStats) -> None:
        self.limits, self._stats = limits, stats
        self.open: set[Connection] = set()
        self.stopping = False

    def arrive(self, transport: asyncio.Transport) -> Connection:
        """Note a new connection."""
        unauthenticated = [known for known in self.open if not (known.admitted or known.busy)]
        if len(unauthenticated) >= MAX_UNAUTHENTICATED:
            self._forget(min(unauthenticated, key=_silence)).transport.abort()
        connection = Connection(transport)
        connection.wait(HEAD_S)
        self.open.add(connection)
        return connection

    def admit(self, connection: Connection) -> bool:
        """Give a connection a place, if there is one or can be made one."""
        if self.stopping:
            return False
        guests = [known for known in self.open if known.admitted and known is not connection]
        if len(guests) >= self.limits.connections:
            silent = [connected for connected in guests if not connected.busy]
            if not silent:
                return False
            first = min(silent, key=lambda connected: (connected.websocket, _silence(connected)))
            first.admitted = False
            first.close(1001, FULL)
            self._stats.count("let_go")
        connection.admitted = True
        self._count()
        return True

    def leave(self, connection: Connection) -> None:
        """Free the place of a connection, gone or about to go."""
        connection.admitted = False
        self._count()

    def gone(self, connection: Connection) -> None:
        """Forget a connection that is closed."""
        self._forget(connection)

    def close_idle(self, code: int, reason: str) -> None:
        """End all that wait for no answer; the others end after theirs."""
        for connection in list(self.open):
            if connection.websocket or not connection.busy:
                connection.close(code, reason)

    def abort(self) -> None:
        """Cut what is left."""
        for connection in list(self.open):
            connection.transport.abort()

    async def watch(self) -> None:
        """End connections that are silent, stalled, or take no answers, for as long as the server runs."""
        limits = self.limits
        every = min(1.0, limits.idle_s / 4, limits.send_s / 4, limits.receive_s / 4)
        while True:
            await asyncio.sleep(every)
            now = time.monotonic()
            for connection in list(self.open):
                self._supervise(connection, now)

    def _supervise(self, connection: Connection, now: float) -> None:
        if connection.transport.get_write_buffer_size() == 0:
            connection.unsent_since = None
        elif connection.unsent_since is None:
            connection.unsent_since = now
        elif now - connection.unsent_since > self.limits.send_s:
            self._stats.count("too_slow")
            connection.transport.abort()
        if connection.until is None or connection.busy or now < connection.until:
            return
        silent = connection.websocket and now - connection.silent_since >= self.limits.idle_s
        if silent and not connection.dismissed.done():
            connection.close(1001, IDLE)
        else:
            connection.transport.abort()

    def _forget(self, connection: Connection) -> Connection:
        self.open.discard(connection)
        self.leave(connection)
        return connection

    def _count(self) -> None:
        self._stats.connections = sum(connection.admitted for connection in self.open)


def _silence(connection: Connection) -> float:
    return connection.silent_since


class HttpProtocol(H11Protocol):
    """HTTP/1.1 until a request asks for a websocket."""

    def __init__(self, config: Any, server_state: Any, app_state: dict[str, Any], _loop: Any = None) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._connections: Connections = app_state["connections"]
        self._in_head = True

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Note who came; the record travels in `scope["state"]`."""
        super().connection_made(transport)
        self._connection = self._connections.arrive(transport)
        self.app_state = {**self.app_state, "connection": self._connection}

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget it."""
        super().connection_lost(exc)
        self._connections.gone(self._connection)

    def data_received(self, data: bytes) -> None:
        """Take what came; what cannot become a request is refused without waiting for the end of its line."""
        if self.cycle is None and not self.conn.trailing_data[0] and not data[:3].isalpha():
            return self.send_400_response("This is neither HTTP nor a websocket.")
        super().data_received(data)
        return self._settle()

    def eof_received(self) -> None:
        """Say what is wrong with a request that was cut short."""
        if self.conn.their_state is h11.SEND_BODY or self.conn.trailing_data[0]:
            super().data_received(b"")

    def on_response_complete(self) -> None:
        """Wait for the next request, but not for ever."""
        super().on_response_complete()
        self._settle()

    def send_400_response(self, msg: str) -> None:
        """Refuse what is no HTTP; where an answer has begun already, all there is left is to hang up."""
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            super().send_400_response(msg + "\n")
        else:
            self.transport.close()

    def _settle(self) -> None:
        connection = self._connection
        if connection.websocket or self.transport.is_closing():
            return
        busy = self.cycle is not None and not self.cycle.response_complete
        if busy != connection.busy:
            connection.work(busy)
        in_head = not busy and bool(self.conn.trailing_data[0])
        if busy:
            connection.wait(None)
        elif in_head and not self._in_head:
            connection.wait(HEAD_S)
        elif not in_head and self.cycle is not None:
            connection.wait(self._connections.limits.idle_s)
        self._in_head = in_head or self.cycle is None


class WebSocketProtocol(WebSocketsSansIOProtocol):
    """A websocket, from its handshake on."""

    def __init__(self, config: Any, server_state: Any, app_state: dict[str, Any], _loop: Any = None) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._connections: Connections = app_state["connections"]
        self._connection: Connection = app_state["connection"]
        self._connection.websocket = True
        self._pieces = 0

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget it."""
        super().connection_lost(exc)
        self._connections.gone(self._connection)

    def data_received(self, data: bytes) -> None:
        """Take what came, and expect more of a message that has begun."""
        super().data_received(data)
        limits = self._connections.limits
        within = self.frames or self.conn.reader.buffer
        connection = self._connection
        if connection.dismissed.done():
            return
        if within and not self.read_paused:
            connection.wait(limits.receive_s)
        else:  # an answer to a ping is no sign that the episode continues
            connection.until = connection.silent_since + limits.idle_s

    def handle_text(self, event: Any) -> None:
        """Begin a message of text."""
        self._pieces = 0
        super().handle_text(event)

    def handle_bytes(self, event: Any) -> None:
        """Begin a message."""
        self._pieces = 0
        super().handle_bytes(event)

    def handle_cont(self, event: Any) -> None:
        """Add to a message; its size is bounded already, this bounds what its pieces cost, empty ones included."""
        self._pieces += 1
        if self._pieces > MOST_PIECES:
            self.conn.fail(1009, "a message in too many pieces")
            return self.handle_parser_exception()
        return super().handle_cont(event)
