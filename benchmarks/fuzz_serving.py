"""Malformed messages by websocket and HTTP, honest clients beside them: `python benchmarks/fuzz_serving.py [messages]`.

Starts `python -m mme_vla.serve` in a process of its own on loopback and sends it 100,000 malformed messages a transport
(or as many as asked for): random bytes, honest messages cut, spliced and with bytes changed, values and keys exchanged,
and containers that claim to be huge. Two honest clients, one a transport, run episodes all the while; every chunk of
theirs is compared with the one the same episode got before. It fails if one differs, if memory grows, if the server
logs a traceback, or if a malformed message gets anything but an answer with a reason. Seeds are fixed; it stops by
itself. Reads memory from /proc (Linux).
"""

import argparse
import http.client
import random
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from contextlib import ExitStack, suppress
from typing import Any

import numpy as np
from serving_soak import COMMAND, challenge, resident_mib
from timing import machine
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from mme_vla.serving import Client, pack, unpack
from mme_vla.testing.small import moving_frames, small_policy

THREADS = 2  # a transport
ROUNDS = 2
ODD: list[Any] = [
    None, True, -1, 2**63, 1e400, float("nan"), "", "\u202e", "x" * 5000, b"", [], {}, [[]] * 50, {"a": {}}, [None],
]  # fmt: skip


def honest(seed: int, size: int = 32) -> list[dict[str, Any]]:
    """The messages of an episode in the challenge's schema."""
    frames = moving_frames(4 + 4 * ROUNDS, seed=seed, size=size)
    states = np.random.default_rng(seed).uniform(-1, 1, (len(frames), 8)).astype(np.float32)
    parts = [slice(0, 4), *(slice(4 + 4 * i, 8 + 4 * i) for i in range(ROUNDS))]
    return [challenge(frames[part], states[part], first=i == 0) for i, part in enumerate(parts)]


class Mutations:
    """Malformed messages, the same for the same seed."""

    def __init__(self, seed: int) -> None:
        self._rng = random.Random(seed)
        first, later, *_ = honest(0, size=8)
        image = np.zeros((8, 8, 3), np.uint8)
        state = np.zeros(8, np.float32)
        view = {"observation/image": image, "observation/wrist_image": image, "observation/state": state}
        buffer = {"add_buffer": True, "images": image[None, None], "state": state[None], "exec_start_idx": 0}
        self._messages: list[dict[str, Any]] = [first, later, {**view, "prompt": "go"}, buffer, {"reset": True}]
        self._packed = [pack(message) for message in self._messages]

    def next(self) -> bytes:
        """One more."""
        kinds = (self._noise, self._bytes, self._cut, self._splice, self._values, self._values, self._claims)
        return self._rng.choice(kinds)()

    def _noise(self) -> bytes:
        return self._rng.randbytes(self._rng.randrange(1, 400))

    def _bytes(self) -> bytes:
        data = bytearray(self._rng.choice(self._packed))
        for _ in range(self._rng.randrange(1, 8)):
            data[min(self._rng.randrange(len(data)), self._rng.randrange(len(data)))] = self._rng.randrange(256)
        return bytes(data)

    def _cut(self) -> bytes:
        data = self._rng.choice(self._packed)
        return data[: self._rng.randrange(1, len(data))]

    def _splice(self) -> bytes:
        one, other = self._rng.sample(self._packed, 2)
        return one[: self._rng.randrange(1, len(one))] + other[self._rng.randrange(len(other)) :]

    def _values(self) -> bytes:
        message = dict(self._rng.choice(self._messages))
        key = self._rng.choice(list(message))
        odd = self._rng.choice(ODD)
        how = self._rng.randrange(4)
        if how == 0 and isinstance(message[key], list):
            message[key] = [*message[key], odd]
        elif how == 1:
            del message[key]
            message[str(key)[:-1]] = odd
        elif how == 2 and isinstance(message[key], np.ndarray):
            message[key] = message[key][..., :-1].astype(self._rng.choice(["<f8", "|b1", "<U1", ">i2"]))
        else:
            message[key] = odd
        return pack(message)

    def _claims(self) -> bytes:
        size = self._rng.choice([0, 1, 17, 2**16, 2**31, 2**32 - 1])
        tag = self._rng.choice([0xC6, 0xC9, 0xDB, 0xDD, 0xDF])
        inner = self._rng.choice([b"\x80", b"\x90", b"\x91" * 600, b"\xc0", b"\xdd\x00\x01\x00\x00"])
        return bytes([tag]) + struct.pack(">I", size) + inner * self._rng.randrange(1, 200)


class Fuzz:
    """The clients' shared notes."""

    def __init__(self, port: int, messages: int) -> None:
        self.port, self.messages = port, messages
        self.counts: Counter[str] = Counter()
        self.wrong: list[str] = []
        self.worst, self.done = 0.0, threading.Event()
        self.episodes = [honest(seed) for seed in (1, 2)]
        self.expected = [self._alone(messages) for messages in self.episodes]

    def _alone(self, messages: list[dict[str, Any]]) -> list[np.ndarray]:
        with Client(f"ws://127.0.0.1:{self.port}") as client:
            return [client.infer(message)["actions"] for message in messages]

    def _compare(self, which: int, step: int, actions: np.ndarray) -> None:
        error = float(np.abs(actions - self.expected[which][step]).max())
        self.worst = max(self.worst, error)
        self.counts["honest chunks"] += 1
        if error != 0:
            self.wrong.append(f"episode {which}, request {step}: off by {error:.1e}")

    def _check_reply(self, transport: str, reply: bytes | str) -> None:
        refused = isinstance(reply, str)
        self.counts[f"{transport} {'refused' if refused else 'happened to be well-formed'}"] += 1
        if refused and (not reply.strip() or "Traceback" in reply or "server failed" in reply):
            self.wrong.append(f"{transport}: answered {reply[:200]!r}")

    def websocket(self, number: int) -> None:
        """Malformed messages; each connection is used until the server ends it."""
        mutations, socket, ends = Mutations(number), None, ExitStack()
        for _ in range(self.messages // THREADS):
            if socket is None:
                address = f"ws://127.0.0.1:{self.port}"
                socket = ends.enter_context(connect(address, compression=None, ping_timeout=600))
                socket.recv(120)
            try:
                with suppress(ConnectionClosed):
                    socket.send(mutations.next())
                reply = socket.recv(120)
            except ConnectionClosed as closed:
                self.wrong.append(f"websocket: closed without an answer: {closed}")
                socket = None
                continue
            self._check_reply("websocket", reply)
            if isinstance(reply, str):
                ends.close()
                socket = None

    def http(self, number: int) -> None:
        """Malformed bodies, on connections that are kept."""
        mutations, connection = Mutations(number), http.client.HTTPConnection("127.0.0.1", self.port, timeout=120)
        for _ in range(self.messages // THREADS):
            connection.request("POST", "/infer", mutations.next(), {"X-Session": f"fuzz {number}"})
            reply = connection.getresponse()
            body = reply.read()
            if reply.status >= 500 or (reply.status >= 400 and not body):
                self.wrong.append(f"HTTP {reply.status}: {body[:200]!r}")
            self._check_reply("HTTP", body if reply.status == 200 else body.decode())

    def honest_websocket(self) -> None:
        """Episodes that must not notice any of it."""
        while not self.done.is_set():
            for which, messages in enumerate(self.episodes):
                with Client(f"ws://127.0.0.1:{self.port}", timeout=120) as client:
                    for step, message in enumerate(messages):
                        self._compare(which, step, client.infer(message)["actions"])

    def honest_http(self) -> None:
        """The same by HTTP."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=120)
        while not self.done.is_set():
            for which, messages in enumerate(self.episodes):
                for step, message in enumerate(messages):
                    connection.request("POST", "/infer", pack(message), {"X-Session": "honest"})
                    self._compare(which, step, unpack(connection.getresponse().read())["actions"])

    def guarded(self, work: Any, *args: Any) -> None:
        """Run in a thread; what goes wrong is a finding."""
        try:
            work(*args)
        except Exception as error:
            self.wrong.append(f"{work.__name__}: {type(error).__name__}: {error}")


def fuzz_server(checkpoint: str, messages: int) -> int:
    """Serve a checkpoint, fuzz it, print the figures; 1 if anything was not as it must be."""
    server = subprocess.Popen([sys.executable, *COMMAND, f"checkpoint={checkpoint}"], stderr=subprocess.PIPE, text=True)
    assert server.stderr is not None
    log: list[str] = []
    for line in server.stderr:
        log.append(line)
        if "ready at" in line:
            break
    reader = threading.Thread(target=lambda: log.extend(server.stderr or ()), daemon=True)
    reader.start()
    try:
        fuzz = Fuzz(int(log[-1].split("127.0.0.1:")[1].split()[0]), messages)
        begun = time.monotonic()
        clients = (fuzz.honest_websocket, fuzz.honest_http)
        beside = [threading.Thread(target=fuzz.guarded, args=(work,)) for work in clients]
        attack = [threading.Thread(target=fuzz.guarded, args=(work, 10 * kind + number))
                  for kind, work in enumerate((fuzz.websocket, fuzz.http)) for number in range(THREADS)]  # fmt: skip
        for thread in (*beside, *attack):
            thread.start()
        memory: list[float] = []
        while any(thread.is_alive() for thread in attack) and server.poll() is None:
            memory.append(resident_mib(server.pid))
            time.sleep(1)
        fuzz.done.set()
        for thread in (*attack, *beside):
            thread.join()
        seconds = time.monotonic() - begun
    finally:
        server.terminate()
        code = server.wait(60)
    reader.join(10)

    third = max(len(memory) // 3, 1)
    early, late = statistics.median(memory[third : 2 * third]), statistics.median(memory[-third:])
    print(machine())
    print(f"{messages} malformed messages a transport, {seconds:.0f} s:", dict(sorted(fuzz.counts.items())))
    print(f"honest actions differ from a quiet run's by {fuzz.worst:.1e}")
    print(f"memory MiB: start {memory[0]:.0f}, median of middle third {early:.0f}, of last third {late:.0f}")
    tracebacks = sum("Traceback" in line for line in log)
    print(f"tracebacks {tracebacks}, exit code {code}; last words: {log[-1].strip()}")
    problems = [*fuzz.wrong, *(["a traceback"] * tracebacks), *([f"exit code {code}"] if code else [])]
    if late > early * 1.05:
        problems.append(f"memory grew from {early:.0f} to {late:.0f} MiB")
    if not fuzz.counts["honest chunks"]:
        problems.append("no honest chunk was compared")
    print("\n".join(["PROBLEMS", *problems[:20], *log[-20:]]) if problems else "no problem")
    return bool(problems)


def main(messages: int) -> int:
    """Fuzz a small policy whose actions its memory changes."""
    with tempfile.TemporaryDirectory() as folder:
        small_policy("framesamp_modul").save_pretrained(folder)
        return fuzz_server(folder, messages)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "messages", nargs="?", type=int, default=100_000, help="of each transport (default: %(default)s)"
    )
    raise SystemExit(main(parser.parse_args().messages))
