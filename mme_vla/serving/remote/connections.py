"""Connections to servers: by websocket (`Client`), by HTTP, and with the harness's messages."""

import http.client
import select
import socket
import threading
import time
import uuid
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from mme_vla.errors import UserError, brief
from mme_vla.serving.client import (
    LARGEST_REPLY,
    Client,
    ConnectionClosed,
    closed,
    decoded_map,
    key_header,
    open_socket,
)
from mme_vla.serving.codec import MOST_TEXT, check_size, encode, msgpack, pack, read_array

PAUSE_S = 0.5  # between two attempts to open a connection
STARTUP_S = 2.0  # in which a server that sends its metadata first has sent them


def open_patiently[T](connect: Callable[[], T], seconds: float) -> T:
    """Open a connection; a server that is not there, or is full, is tried for so many seconds.

    Raises:
        UserError: there is none by then, or the server refuses the connection.
        TimeoutError: the server says nothing.
    """
    until = time.monotonic() + seconds
    while True:
        try:
            return connect()
        except ConnectionError as error:
            if time.monotonic() >= until:
                raise UserError(
                    f"{str(error).rstrip('.')}. Start the server, then repeat the command: finished"
                    " episodes are kept."
                ) from None
        time.sleep(PAUSE_S)


class HttpConnection:
    """The challenge's HTTP: `/metadata`, `/reset` and `/infer`, in one session.

    Args:
        url: `http://host:port`, with the path before `/metadata` if there is one.
        api_key: of the server, if it has one.
        timeout: seconds to wait for a reply, all of it.
        open_timeout: for the connection.
    """

    def __init__(
        self,
        url: str,
        api_key: str | None = None,
        timeout: float = 600,
        open_timeout: float = 60,
    ) -> None:
        self.url = url.rstrip("/")
        self._timeout = timeout
        address = urlsplit(url)
        self._headers = {
            "Content-Type": "application/msgpack",
            "Accept": "application/msgpack",
            "X-Session": uuid.uuid4().hex,
            **key_header(api_key),
        }
        host = address.hostname or ""
        self._path = address.path.rstrip("/")
        self._http = http.client.HTTPConnection(host, address.port, timeout=open_timeout)
        if address.scheme == "https":
            self._http = http.client.HTTPSConnection(host, address.port, timeout=open_timeout)
        self.metadata = self._exchange("GET", "/metadata", None)

    def request(self, message: Mapping[str, Any]) -> dict[str, Any]:
        path = "/reset" if message.get("reset") else "/infer"
        return self._exchange("POST", path, pack(message))

    def close(self) -> None:
        if self._http.sock is not None:
            _shut(self._http.sock)
        self._http.close()

    def _exchange(self, method: str, path: str, body: bytes | None) -> dict[str, Any]:
        late = threading.Event()
        is_open = False
        try:
            if self._http.sock is not None:
                waiting = select.poll()
                waiting.register(self._http.sock, select.POLLIN)
                if waiting.poll(0):  # the server closed it, as many do after seconds of silence
                    self._http.close()
            if self._http.sock is None:
                self._http.connect()
            stream = self._http.sock
            stream.settimeout(self._timeout)
            is_open = True
            # The socket's time-out is that of one read, and a byte now and then is within it.
            watch = threading.Timer(self._timeout, _shut, (stream, late))
            watch.daemon = True
            watch.start()
            try:
                self._http.request(method, self._path + path, body, self._headers)
                response = self._http.getresponse()
                content = response.read(LARGEST_REPLY + 1)
            finally:
                watch.cancel()
            if response.length and len(content) <= LARGEST_REPLY:
                raise http.client.IncompleteRead(content, response.length)
        except (OSError, http.client.HTTPException) as error:
            self.close()
            # The socket may notice before the watch does.
            if late.is_set() or (is_open and isinstance(error, TimeoutError)):
                raise TimeoutError(
                    f"No answer from {self.url}{path} within {self._timeout:g} s."
                ) from None
            raise ConnectionError(f"No policy server responds at {self.url}: {error}") from error
        if len(content) > LARGEST_REPLY:
            self.close()
            raise UserError(
                f"The server's reply is malformed: more than {LARGEST_REPLY:,} bytes from"
                f" {self.url}{path}."
            )
        if response.status == http.HTTPStatus.OK:
            return decoded_map(content)
        reason = brief(content.decode(errors="replace").strip(), 400, quote=False)
        text = f"{self.url}{path}: {response.status} {reason}"
        # The episode is lost, or there is no place now: both may be better at the next try.
        if response.status in (http.HTTPStatus.CONFLICT, http.HTTPStatus.SERVICE_UNAVAILABLE):
            raise ConnectionError(text)
        raise UserError(f"The server refuses this request: {text}")


def _shut(stream: socket.socket, late: threading.Event | None = None) -> None:
    """Shut a socket, which another thread may be reading."""
    if late is not None:
        late.set()
    with suppress(OSError):  # it may be closed already
        stream.shutdown(socket.SHUT_RDWR)


class HarnessConnection:
    """The protocol of vla-evaluation-harness 0.8: typed messages with a number, the client's first.

    Args:
        url: `ws://host:port`.
        api_key: of the server, if it has one.
        timeout: seconds to wait for a reply.
        open_timeout: for the connection and the first reply.
    """

    VERSION = 1  # of its protocol

    def __init__(
        self,
        url: str,
        api_key: str | None = None,
        timeout: float = 600,
        open_timeout: float = 60,
    ) -> None:
        self.url = url
        self._timeout = open_timeout
        self._sequence = 0
        self._socket = open_socket(url, key_header(api_key), open_timeout, timeout)
        hello = {"harness_version": "0.8.0", "protocol_version": self.VERSION}
        try:
            self.metadata = self._reply("hello", self.send("hello", hello))
        except BaseException:
            self.close()
            raise
        self._timeout = timeout

    def send(self, kind: str, payload: Mapping[str, Any]) -> int:
        """Send a message that needs no reply; return its number."""
        self._sequence += 1
        message = {
            "type": kind,
            "payload": payload,
            "seq": self._sequence,
            "timestamp": time.time(),
        }
        try:
            self._socket.send(msgpack.packb(message, default=_encode))
        except ConnectionClosed as error:
            raise closed(self.url, error) from None
        return self._sequence

    def request(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Send an observation and return the action."""
        return self._reply("action", self.send("observation", message))

    def close(self) -> None:
        self._socket.close()

    def _reply(self, kind: str, number: int) -> dict[str, Any]:
        """The payload of the reply to a message.

        An error of an earlier message, such as the beginning of the episode, counts as well.
        """
        try:
            data = self._socket.recv(self._timeout)
        except TimeoutError:
            self.close()
            raise TimeoutError(f"No answer from {self.url} within {self._timeout:g} s.") from None
        except ConnectionClosed as error:
            raise closed(self.url, error) from None
        message = _decoded(data)
        payload = message.get("payload")
        # As texts: an array in their place has no single truth value.
        name = str(message.get("type"))
        if name == "error":
            raise UserError(f"The server refuses this request: {brief(payload, 400)}")
        is_reply = name == kind and str(message.get("seq")) == str(number)
        if not is_reply or not isinstance(payload, dict):
            raise UserError(
                f"The server's reply is malformed: {kind} number {number} was expected, and it is"
                f" {brief(message.get('type'))} number {brief(message.get('seq'))}."
            )
        return payload


def _encode(value: Any) -> Any:
    """An array as the harness has it: the keys are texts, not bytes, and scalars are numbers."""
    if isinstance(value, np.generic):
        return value.item()
    return {key.decode(): entry for key, entry in encode(value).items()}


def _decoded(data: Any) -> dict[str, Any]:
    if isinstance(data, str):
        raise UserError(f"The server's reply is malformed: the text {brief(data, 200)}.")

    def array(fields: dict[Any, Any]) -> Any:
        if "__ndarray__" in fields:
            return read_array({str(key).encode(): value for key, value in fields.items()}).copy()
        return fields

    try:
        check_size(data)
        message = msgpack.unpackb(data, object_hook=array, max_str_len=MOST_TEXT, max_ext_len=0)
    except Exception as error:  # msgpack raises many kinds of exception
        raise UserError(f"The server's reply is malformed: {error}") from error
    if not isinstance(message, dict):
        raise UserError(f"The server's reply is malformed: {brief(message)} is no map.")
    return message


Connection = Client | HttpConnection | HarnessConnection
"""One connection to a server, with one episode at a time.

Requests raise `UserError` where the server refuses one or its reply cannot be read, and
`ConnectionError` or `TimeoutError` where there is no reply.
"""
