"""`Client`: talk to a policy server from Python, in either schema."""

import re
import socket
import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, Self

import numpy as np

from mme_vla.errors import UserError, brief, missing_extra
from mme_vla.serving.codec import pack, unpack

try:
    from websockets.exceptions import (
        ConnectionClosed,
        InvalidHandshake,
        InvalidStatus,
        InvalidURI,
    )
    from websockets.frames import CloseCode
    from websockets.sync.client import connect
    from websockets.uri import parse_uri
except ImportError as error:
    raise missing_extra("The client", "serve") from error

LARGEST_REPLY = 2**26  # bytes; a chunk has some thousand


class FullError(UserError, ConnectionError):
    """The server has no place for another client now."""


class Client:
    """A connection to a policy server; blocking, for one thread.

    The episode lives on the server with the connection and is lost with it, so nothing reconnects
    by itself: after a `ConnectionError` call `reconnect()` and begin the episode again.

    Args:
        url: `ws://host:port`.
        api_key: of the server, if it has one.
        timeout: seconds to wait for an answer; a first request of 1,000 frames may take minutes on
            a CPU.
        open_timeout: seconds to wait for the connection and the server's metadata.

    Raises:
        UserError: not an address of a server, or the key is refused.
        ConnectionError: there is no server.

    >>> with Client("ws://127.0.0.1:8001") as client:  # doctest: +SKIP
    ...     client.reset()
    ...     chunk = client.infer({"task_goal": [goal], "is_first_step": True, ...})["actions"]
    """

    def __init__(
        self,
        url: str = "ws://127.0.0.1:8001",
        *,
        api_key: str | None = None,
        timeout: float = 600,
        open_timeout: float = 60,
    ) -> None:
        self.url = url
        self.timeout = timeout
        self.open_timeout = open_timeout
        self._headers = key_header(api_key)
        self._address = without_user(url)  # for messages
        self._socket: Any = None
        self.metadata: dict[str, Any] = {}
        """Description of the server, its first message."""
        self.reconnect()

    def reconnect(self) -> None:
        """Close the connection if there is one and open another, with an episode that has not
        begun.
        """
        self.close()
        self._socket = open_socket(self.url, self._headers, self.open_timeout, self.timeout)
        self.metadata = self._receive(self.open_timeout)

    def reset(self, seed: int | None = None) -> dict[str, Any]:
        """Begin an episode, its noise from this seed, else from the server's."""
        message: dict[str, Any] = {"reset": True}
        if seed is not None:
            message["seed"] = seed
        return self.request(message)

    def add_buffer(
        self, images: np.ndarray, states: np.ndarray, exec_start: int = 0
    ) -> dict[str, Any]:
        """Send frames to remember, the current one included, before `infer` (MME-VLA schema).

        Args:
            images: of the camera that feeds memory (RoboMME: front) [t, H, W, 3] or [t, 1, H, W, 3]
                uint8.
            states: [t, s].
            exec_start: index of the episode's first execution frame, when these frames begin with a
                video.
        """
        images = np.asarray(images)
        if images.ndim == 4:
            images = images[:, None]
        states = np.asarray(states, np.float32)
        return self.request(
            {"add_buffer": True, "images": images, "state": states, "exec_start_idx": exec_start}
        )

    def infer(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """Request the next chunk.

        Args:
            observation: of either schema: `observation/image`, `observation/wrist_image`,
                `observation/state` and `prompt`; or the challenge's lists.

        Returns:
            `actions` [n, w] float32, absolute, and `infer_time_ms`.
        """
        return self.request(observation)

    def request(self, message: Mapping[str, Any] | Sequence[Any]) -> dict[str, Any]:
        """Send one message and return the answer.

        Raises:
            UserError: the server refuses the message, and says why. The episode continues where
                nothing was changed; else the next request raises `ConnectionError`.
            ConnectionError: the connection is lost.
            TimeoutError: no answer within `timeout`; the connection is closed.
        """
        data = pack(message)
        if self._socket is None:
            raise ConnectionError("This client is closed: call reconnect().")
        with suppress(ConnectionClosed):  # the reason may have arrived before the close
            self._socket.send(data)
        return self._receive(self.timeout)

    def close(self) -> None:
        """Close the connection; the server frees the episode."""
        opened = self._socket
        self._socket = None  # first: another thread may be waiting for a reply
        if opened is not None:
            opened.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _receive(self, timeout: float) -> dict[str, Any]:
        try:
            response = self._socket.recv(timeout)
        except ConnectionClosed as error:
            self.close()
            raise closed(self._address, error) from None
        except TimeoutError:
            self.close()  # an answer that came later would be taken for that of the next request
            raise TimeoutError(
                f"No answer from {self._address} within {timeout:g} s; call reconnect()."
            ) from None
        if isinstance(response, str):
            reason = brief(response, 2000, quote=False)
            raise UserError(f"The server refuses this request: {reason}")
        try:
            return decoded_map(response)
        except UserError:
            self.close()
            raise


def key_header(api_key: str | None) -> dict[str, str]:
    """The header that takes a server's key along; none without a key."""
    if api_key is None:
        return {}
    return {"Authorization": f"Api-Key {api_key}"}


def without_user(url: str) -> str:
    """An address for messages, without the user and password before its `@`."""
    return re.sub(r"^(\w+://)?.*@", r"\1…@", url, flags=re.DOTALL)


def open_socket(
    url: str, headers: Mapping[str, str], open_timeout: float, pong_timeout: float
) -> Any:
    """Open a websocket without compression, for replies of at most `LARGEST_REPLY` bytes.

    Args:
        open_timeout: seconds to wait for the handshake.
        pong_timeout: for the reply to a ping, and for a server that reads nothing of what is sent.

    Raises:
        UserError: not an address, or the server refuses this client, or redirects it.
        ConnectionError: there is no server, or (`FullError`) no place for this client now.
    """
    name = without_user(url)
    try:
        address = parse_uri(url)
    except (InvalidURI, ValueError) as error:
        reason = "its host or port is malformed"  # a `ValueError` may quote the password
        if isinstance(error, InvalidURI):
            reason = error.msg
        raise UserError(
            f"{name!r} is not an address such as ws://127.0.0.1:8001: {reason}."
        ) from None
    try:
        stream = socket.create_connection((address.host, address.port), open_timeout)
    except OSError as error:
        raise ConnectionError(f"No policy server responds at {name}: {error}") from error
    stream.settimeout(None)
    seconds = struct.pack("ll", int(pong_timeout), int(pong_timeout % 1 * 1e6))
    stream.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, seconds)
    try:
        return connect(
            url,
            sock=stream,  # of this host alone: a redirect would take the key and the images along
            additional_headers=dict(headers),
            compression=None,
            max_size=LARGEST_REPLY,
            open_timeout=open_timeout,
            ping_timeout=pong_timeout,
            proxy=None,
        ).__enter__()
    except ValueError as error:  # a redirect, for a socket that is open
        raise UserError(f"The server at {name} is elsewhere: {without_user(str(error))}") from None
    except InvalidHandshake as error:
        reply = getattr(getattr(error, "response", None), "body", b"") or b""
        message = bytes(reply).decode(errors="replace").strip() or str(error)
        text = f"The server at {name} refuses the connection: {brief(message, 400, quote=False)}"
        is_full = isinstance(error, InvalidStatus) and error.response.status_code == 503
        if is_full:
            raise FullError(text) from None
        raise UserError(text) from None
    except (OSError, TimeoutError, EOFError) as error:
        raise ConnectionError(f"No policy server responds at {name}: {error}") from error


def closed(name: str, error: ConnectionClosed) -> UserError | ConnectionError:
    """What to raise where a connection to the server `name` is closed: `UserError` where this side
    closed it for the size of a reply, which another try would meet again.
    """
    by_server = error.rcvd is not None and error.rcvd_then_sent
    if error.sent is not None and error.sent.code == CloseCode.MESSAGE_TOO_BIG and not by_server:
        return UserError(f"The server's reply is malformed: {error.sent.reason}.")
    return ConnectionError(f"The server at {name} closed the connection: {error}")


def decoded_map(data: bytes) -> dict[str, Any]:
    """A server's message, with arrays that can be written to.

    Raises:
        UserError: it is no map.
    """
    try:
        fields = unpack(data)
    except UserError as error:
        raise UserError(f"The server's reply is malformed: {error}") from error
    if not isinstance(fields, dict):
        raise UserError(f"The server's reply is malformed: {brief(fields)} is no map.")
    for key, value in fields.items():
        if isinstance(value, np.ndarray):
            fields[key] = value.copy()
    return fields
