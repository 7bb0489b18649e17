"""A small server for each protocol of `evaluate server=…`, to try it without weights.

    python stub_servers.py openpi --port 8000
    python stub_servers.py robomme --port 8001 --fault nan --after 3

Each is written from the protocol's description and needs msgpack, numpy and websockets alone. The
policy behind it is a function of what the server got (`Stream`). `--fault` spoils the replies.
"""

import argparse
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import msgpack
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, serve

PROTOCOLS = ("openpi", "robomme", "challenge", "challenge-http", "harness")
FAULTS = ("none", "error", "garbage", "text", "list", "no_actions", "shape", "nan", "huge",
          "silent", "close")  # fmt: skip


@dataclass
class Stream:
    """What a server was sent of one episode, and what it returned.

    frames: images of the first camera, the conditioning video first.
    n_video: frames of that video.
    """

    goal: str = ""
    frames: list[np.ndarray] = field(default_factory=list)
    states: list[np.ndarray] = field(default_factory=list)
    n_video: int = 0
    chunks: list[np.ndarray] = field(default_factory=list)


Policy = Callable[[Stream], np.ndarray]
"""From an episode's stream to a chunk [h, w]."""


def hold_still(stream: Stream) -> np.ndarray:
    """Sixteen actions that keep the robot where it is."""
    return np.repeat(stream.states[-1][None], 16, axis=0).astype(np.float32)


@dataclass
class Stub:
    """A server's policy and its faults.

    fault: what is wrong with the replies from number `after` on, counted from 0 over all clients;
        `times` of them are.
    requests: every message that came, decoded.
    """

    policy: Policy = hold_still
    fault: str = "none"
    after: int = 0
    times: int = 10**9
    key: str | None = None
    requests: list[Any] = field(default_factory=list)
    replies: int = 0
    lock: Any = field(default_factory=threading.Lock)
    shared: Stream = field(default_factory=Stream)

    def chunk(self, stream: Stream) -> np.ndarray:
        actions = np.asarray(self.policy(stream), np.float32)
        stream.chunks.append(actions)
        return actions

    def next_fault(self) -> str:
        with self.lock:
            number = self.replies
            self.replies += 1
        if self.after <= number < self.after + self.times:
            return self.fault
        return "none"


class FaultError(Exception):
    """A fault that ends the connection without a reply."""


def spoiled(fault: str, reply: dict[str, Any], packed: Callable[[Any], bytes]) -> bytes | str:
    """The reply as the fault has it."""
    actions = reply["actions"]
    if fault == "garbage":
        return b"\xc1\xc1\xc1"  # no message of msgpack begins so
    if fault == "text":
        return "Traceback (most recent call last): out of memory"
    if fault == "list":
        return packed([1, 2, 3])
    if fault == "no_actions":
        return packed({"action": actions})
    if fault == "shape":
        return packed({**reply, "actions": np.concatenate([actions, actions], axis=-1)})
    if fault == "nan":
        return packed({**reply, "actions": actions * np.nan})
    if fault == "huge":
        return packed({**reply, "actions": actions + 1e9})
    if fault == "silent":
        time.sleep(2)
    if fault in ("silent", "close"):
        raise FaultError
    return packed(reply)


# Messages. Arrays are maps, with keys that are bytes, or texts in the harness.


def pack(message: Any, text: bool = False) -> bytes:
    def encode(value: Any) -> Any:
        if isinstance(value, np.generic):
            return value.item()
        fields = {"__ndarray__": True, "data": value.tobytes(), "dtype": value.dtype.str,
                  "shape": list(value.shape)}  # fmt: skip
        return fields if text else {key.encode(): one for key, one in fields.items()}

    return msgpack.packb(message, default=encode)


def unpack(data: bytes) -> Any:
    def decode(fields: dict[Any, Any]) -> Any:
        named = {key.decode() if isinstance(key, bytes) else key: fields[key] for key in fields}
        if "__ndarray__" not in named:
            return fields
        return np.frombuffer(named["data"], named["dtype"]).reshape(named["shape"])

    return msgpack.unpackb(data, object_hook=decode)


# The protocols. Each takes a request and the episode's stream so far, and returns a reply.


def observe_openpi(stub: Stub, request: dict[str, Any], stream: Stream) -> dict[str, Any]:
    """One frame a request. A key that is missing is an error, as in the transforms of openpi."""
    images = [value for value in request.values() if np.ndim(value) == 3]
    stream.frames.append(images[0])
    stream.states.append(request["observation/state"])
    stream.goal = request["prompt"]
    begun = time.monotonic()
    actions = stub.chunk(stream)
    return {"actions": actions, "server_timing": {"infer_ms": 1e3 * (time.monotonic() - begun)}}


def observe_robomme(stub: Stub, request: dict[str, Any], stream: Stream) -> dict[str, Any]:
    """Past frames come by `add_buffer`; the memory is one for all connections."""
    stream = stub.shared
    if request.get("reset", False):
        stub.shared = Stream()
        return {"reset_finished": True, "reset_time_ms": 0.1}
    if request.get("add_buffer", False):
        stream.frames += list(request["images"][:, 0])
        stream.states += list(request["state"])
        if request["exec_start_idx"] > 0:
            stream.n_video = request["exec_start_idx"]
        return {"add_buffer_finished": True, "add_buffer_time_ms": 0.1}
    if not stream.frames:
        raise AssertionError("a policy with a memory needs a buffer")
    stream.goal = request["prompt"]
    return {"actions": stub.chunk(stream), "infer_time_ms": 0.1}


def observe_challenge(stub: Stub, request: dict[str, Any], stream: Stream) -> dict[str, Any]:
    """All frames since the last request, in lists; the memory is one for all connections."""
    if request.get("reset", False):
        stub.shared = Stream()
        return {"reset_finished": True}
    stream = stub.shared
    if request["is_first_step"]:
        stream.n_video = len(request["front_rgb_list"]) - 1
    stream.goal = request["task_goal"][0]
    stream.frames += request["front_rgb_list"]
    joints = zip(request["joint_state_list"], request["gripper_state_list"], strict=True)
    stream.states += [np.concatenate([arm, fingers[:1]]) for arm, fingers in joints]
    return {"actions": stub.chunk(stream)}


def talk(stub: Stub, observe: Callable[[Stub, Any, Stream], dict[str, Any]], peer: Any) -> None:
    """Metadata first, then a reply to each request; an error is a text, and ends the connection."""
    peer.send(pack({"policy": "stub"}))
    stream = Stream()
    for data in peer:
        request = unpack(data)
        stub.requests.append(request)
        try:
            reply = observe(stub, request, stream)
        except Exception as error:
            peer.send(f"Traceback (most recent call last): {type(error).__name__}: {error}")
            peer.close(1011, "error")
            return
        fault = stub.next_fault() if "actions" in reply else "none"
        if fault == "error":
            fault = "text"
        spoilt = pack(reply) if fault == "none" else spoiled(fault, reply, pack)
        peer.send(spoilt)
        if isinstance(spoilt, str):
            peer.close(1011, "error")
            return


def talk_harness(stub: Stub, peer: Any) -> None:
    """Typed messages; the client greets first. One action for each observation."""
    stream = Stream()
    for data in peer:
        message = unpack(data)
        stub.requests.append(message)
        kind, payload = message["type"], message["payload"]
        reply: dict[str, Any] = {}
        reply_kind = "action"
        if kind == "hello":
            reply_kind = "hello"
            params = {"send_state": True, "send_video_history": True}
            reply = {"harness_version": "0.8.0", "protocol_version": 1,
                     "observation_params": params}  # fmt: skip
        elif kind == "episode_start":
            stream = Stream()
        elif kind == "observation":
            video = payload.get("video_history", [])
            stream.n_video += len(video)
            stream.frames += [*video, next(iter(payload["images"].values()))]
            stream.states.append(payload["states"])
            stream.goal = payload["task_description"]
            reply = {"actions": stub.chunk(stream)[0]}
        if not reply:
            continue

        def packed(content: Any, name: str = reply_kind, number: int = message["seq"]) -> bytes:
            kind = "error" if content == "error" else name
            return pack({"type": kind, "payload": content, "seq": number, "timestamp": 0.0}, True)

        fault = stub.next_fault() if kind == "observation" else "none"
        if fault == "error":
            peer.send(packed("error"))
        elif fault == "none":
            peer.send(packed(reply))
        else:
            peer.send(spoiled(fault, reply, packed))


def http_handler(stub: Stub) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            self.respond(200, pack({"policy": "stub"}))

        def do_POST(self) -> None:
            request = unpack(self.rfile.read(int(self.headers["Content-Length"])))
            stub.requests.append(request)
            if stub.key is not None and self.headers["Authorization"] != f"Api-Key {stub.key}":
                return self.respond(401, b"the key is wrong")
            try:
                reply = observe_challenge(stub, request, stub.shared)
                fault = stub.next_fault() if "actions" in reply else "none"
                if fault == "error":
                    return self.respond(500, b"Traceback (most recent call last): out of memory")
                content = pack(reply) if fault == "none" else spoiled(fault, reply, pack)
            except FaultError:
                self.close_connection = True
                return self.connection.shutdown(socket.SHUT_RDWR)
            self.respond(200, content.encode() if isinstance(content, str) else content)

        def respond(self, status: int, content: bytes) -> None:
            self.send_response(status)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: Any) -> None:
            """Nothing is logged."""

    return Handler


def make_server(protocol: str, stub: Stub, port: int = 0) -> Server | ThreadingHTTPServer:
    """A server that listens on this machine; its port is in `socket.getsockname()`."""
    if protocol == "challenge-http":
        web = ThreadingHTTPServer(("127.0.0.1", port), http_handler(stub))
        web.daemon_threads = True
        return web
    observers = {"openpi": observe_openpi, "robomme": observe_robomme,
                 "challenge": observe_challenge}  # fmt: skip

    def handle(peer: Any) -> None:
        key = peer.request.headers.get("Authorization")
        if stub.key is not None and key != f"Api-Key {stub.key}":
            peer.close(1008, "the key is wrong")
            return
        try:
            if protocol == "harness":
                talk_harness(stub, peer)
            else:
                talk(stub, observers[protocol], peer)
        except (ConnectionClosed, FaultError):
            peer.socket.close()

    return serve(handle, "127.0.0.1", port, compression=None, max_size=None)


@contextmanager
def serving(protocol: str, stub: Stub) -> Iterator[str]:
    """The address of a server that runs within the block."""
    server = make_server(protocol, stub)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    scheme = "http" if protocol == "challenge-http" else "ws"
    try:
        yield f"{scheme}://127.0.0.1:{server.socket.getsockname()[1]}"
    finally:
        server.shutdown()
        thread.join(10)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("protocol", choices=PROTOCOLS)
    parser.add_argument("--port", type=int, default=8000)
    parser.add_argument("--fault", choices=FAULTS, default="none")
    parser.add_argument("--after", type=int, default=0, help="good replies before the fault")
    options = parser.parse_args()
    stub = Stub(fault=options.fault, after=options.after)
    server = make_server(options.protocol, stub, options.port)
    print(f"{options.protocol} at port {server.socket.getsockname()[1]}", flush=True)
    server.serve_forever()
