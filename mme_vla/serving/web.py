"""Plain HTTP/1.1 beside the websocket: one door looks at a connection's first lines and leads it to the right side."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from http import HTTPStatus

HEAD = 2**16  # bytes of request line and headers
PIECE = 2**20  # bytes read of a body at a time

Made = Callable[[], asyncio.Protocol]
MSGPACK, TEXT, JSON = "application/msgpack", "text/plain; charset=utf-8", "application/json"


@dataclass(frozen=True)
class HttpRequest:
    """One request; header names are in lower case. `peer` is the client's address without its port."""

    method: str
    path: str
    headers: dict[str, str]
    peer: str
    body: bytes = b""


@dataclass(frozen=True)
class HttpAnswer:
    """One answer; `close` ends the connection after it."""

    status: int = 200
    body: bytes = b""
    kind: str = TEXT
    close: bool = False
    headers: dict[str, str] = field(default_factory=dict)


class BadRequestError(Exception):
    """A request that is not read further: the answer to it ends the connection."""

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status = status


class Door(asyncio.Protocol):
    """Holds a new connection until its headers are there, then hands it to the websocket or to `serve_http`."""

    def __init__(
        self,
        make_websocket: Made,
        serve_http: Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]],
        open_timeout: float = 10,
    ) -> None:
        self._make_websocket, self._serve_http, self._timeout = make_websocket, serve_http, open_timeout
        self._seen = bytearray()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Wait for the first lines, but not for ever."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._timer = asyncio.get_running_loop().call_later(self._timeout, transport.abort)

    def connection_lost(self, error: Exception | None) -> None:
        """Gone before it said what it wants."""
        self._timer.cancel()

    def data_received(self, data: bytes) -> None:
        """Gather the headers; lead the connection on once they are complete, or cannot be."""
        self._seen += data
        head, end, _ = bytes(self._seen[: HEAD + 4]).partition(b"\r\n\r\n")
        if not head[:3].isalpha():  # no method begins like this: do not wait for the end of a line
            self._transport.write(b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\nContent-Length: 0\r\n\r\n")
            return self._transport.close()
        if not end and len(self._seen) < HEAD:
            return None
        self._timer.cancel()
        upgrade = bool(end) and b"\r\nupgrade: websocket" in head.lower().replace(b":websocket", b": websocket")
        transport, seen = self._transport, bytes(self._seen)
        if upgrade and head.startswith(b"GET "):
            protocol = self._make_websocket()
        else:
            reader = asyncio.StreamReader(limit=HEAD)
            protocol = asyncio.StreamReaderProtocol(reader, self._serve_http)
        transport.set_protocol(protocol)
        protocol.connection_made(transport)
        protocol.data_received(seen)
        return None


async def read_head(reader: asyncio.StreamReader, peer: str) -> HttpRequest | None:
    """Read a request's first line and headers; None at the end of the connection.

    Raises:
        BadRequestError: it is no HTTP request.
    """
    try:
        block = await reader.readuntil(b"\r\n\r\n")
    except asyncio.IncompleteReadError as error:
        if not error.partial.strip():
            return None
        raise BadRequestError(400, "This is neither HTTP nor a websocket.") from None
    except asyncio.LimitOverrunError:
        raise BadRequestError(431, "The headers are too long, or this is neither HTTP nor a websocket.") from None
    first, *lines = block.decode("latin-1").strip("\r\n").split("\r\n")
    words = first.split(" ")
    if len(words) != 3 or words[2] not in ("HTTP/1.1", "HTTP/1.0"):
        raise BadRequestError(400, "This is neither HTTP/1.1 nor a websocket.")
    headers: dict[str, str] = {}
    for line in lines:
        name, colon, value = line.partition(":")
        name = name.lower()
        if not colon or not name or name != name.strip():
            raise BadRequestError(400, "A header line is malformed.")
        if name in headers and name in ("content-length", "authorization", "transfer-encoding"):
            raise BadRequestError(400, f"The header {name} stands twice.")
        headers[name] = value.strip()
    if words[2] == "HTTP/1.0":
        headers["connection"] = "close"
    return HttpRequest(words[0], words[1].split("?")[0], headers, peer)


async def read_body(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, request: HttpRequest, most: int, patience: float
) -> bytes:
    """Read the body its Content-Length announces.

    Args:
        most: bytes. patience: seconds without a byte before it gives up.

    Raises:
        BadRequestError: no length, too long, cut short or stalled.
    """
    if "transfer-encoding" in request.headers:
        raise BadRequestError(411, "Send the body in one piece, with Content-Length.")
    announced = request.headers.get("content-length", "0")
    if not (announced.isascii() and announced.isdigit() and len(announced) < 19):
        raise BadRequestError(400, "Content-Length must be a number of bytes.")
    length = int(announced)
    if length > most:
        raise BadRequestError(413, f"The message has {length} bytes; this server takes {most} (limits.message_mib).")
    if length and request.headers.get("expect", "").lower() == "100-continue":
        writer.write(b"HTTP/1.1 100 Continue\r\n\r\n")
    body = bytearray()
    while len(body) < length:
        try:
            piece = await asyncio.wait_for(reader.read(min(PIECE, length - len(body))), patience)
        except TimeoutError:
            raise BadRequestError(408, f"No byte of the body came for {patience:g} s.") from None
        if not piece:
            raise BadRequestError(400, "The body was cut short.")
        body += piece
    return bytes(body)


async def write_answer(writer: asyncio.StreamWriter, answer: HttpAnswer, patience: float) -> None:
    """Send an answer; a client that does not take it within `patience` seconds raises TimeoutError."""
    lines = [
        f"HTTP/1.1 {answer.status} {HTTPStatus(answer.status).phrase}",
        f"Content-Type: {answer.kind}",
        f"Content-Length: {len(answer.body)}",
        *(f"{name}: {value}" for name, value in answer.headers.items()),
        f"Connection: {'close' if answer.close else 'keep-alive'}",
    ]
    writer.write("\r\n".join(lines).encode("latin-1") + b"\r\n\r\n" + answer.body)
    await asyncio.wait_for(writer.drain(), patience)
