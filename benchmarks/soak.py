"""Eight clients, well-behaved and not, against one server: `python benchmarks/soak.py [seconds]`.

Starts `python -m mme_vla.serve` in a process of its own and lets eight clients loose on it for two
minutes. Each does one thing after the other at random: an episode in either schema or by HTTP, a
first message of 1,000 small frames, a disconnect in the middle of a request, malformed messages,
garbage on the wire, a message over the limit. Four episodes are known beforehand, each served
alone: every chunk of theirs is compared, and must differ from the other episodes'. Reads memory
from /proc (Linux).
"""

import argparse
import http.client
import json
import random
import re
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from timing import machine

from mme_vla.errors import UserError
from mme_vla.serving import Client, pack, unpack
from mme_vla.testing.small import moving_frames, small_policy

CLIENTS, EPISODES, ROUNDS, MESSAGE_MIB = 8, 4, 3, 32
LONG = 1000  # frames of a long first message
COMMAND = ["-m", "mme_vla.serve", "port=0", f"limits.message_mib={MESSAGE_MIB}"]
MALFORMED = 20  # malformed messages a client sends before something else
TOLERANCE = 1e-4  # between batches of different sizes

ODD: list[Any] = [
    None,
    True,
    -1,
    2**63,
    1e400,
    float("nan"),
    "",
    "\u202e",
    "x" * 5000,
    b"",
    [],
    {},
    [[]] * 50,
    {"a": {}},
    [None],
]


class Mutations:
    """Malformed messages, the same for the same seed."""

    def __init__(self, seed: int) -> None:
        self._rng = random.Random(seed)
        frames, states = moving_frames(8, size=8), np.zeros((8, 8), np.float32)
        first, later = (
            challenge(frames[part], states[part], first=i == 0)
            for i, part in enumerate((slice(4), slice(4, 8)))
        )
        image = np.zeros((8, 8, 3), np.uint8)
        state = np.zeros(8, np.float32)
        view = {
            "observation/image": image,
            "observation/wrist_image": image,
            "observation/state": state,
        }
        buffer = {
            "add_buffer": True,
            "images": image[None, None],
            "state": state[None],
            "exec_start_idx": 0,
        }
        self._messages: list[dict[str, Any]] = [
            first,
            later,
            {**view, "prompt": "go"},
            buffer,
            {"reset": True},
        ]
        self._packed = [pack(message) for message in self._messages]

    def next(self) -> bytes:
        """The next message."""
        kinds = (
            self._noise,
            self._bytes,
            self._cut,
            self._splice,
            self._values,
            self._values,
            self._claims,
        )
        return self._rng.choice(kinds)()

    def _noise(self) -> bytes:
        return self._rng.randbytes(self._rng.randrange(1, 400))

    def _bytes(self) -> bytes:
        data = bytearray(self._rng.choice(self._packed))
        for _ in range(self._rng.randrange(1, 8)):
            data[min(self._rng.randrange(len(data)), self._rng.randrange(len(data)))] = (
                self._rng.randrange(256)
            )
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
            message[key] = message[key][..., :-1].astype(
                self._rng.choice(["<f8", "|b1", "<U1", ">i2"])
            )
        else:
            message[key] = odd
        return pack(message)

    def _claims(self) -> bytes:
        size = self._rng.choice([0, 1, 17, 2**16, 2**31, 2**32 - 1])
        tag = self._rng.choice([0xC6, 0xC9, 0xDB, 0xDD, 0xDF])
        inner = self._rng.choice(
            [b"\x80", b"\x90", b"\x91" * 600, b"\xc0", b"\xdd\x00\x01\x00\x00"]
        )
        return bytes([tag]) + struct.pack(">I", size) + inner * self._rng.randrange(1, 200)


class Soak:
    """The clients' shared notes."""

    def __init__(self, port: int, seconds: float) -> None:
        self.port, self.until = port, time.monotonic() + seconds
        self.counts: Counter[str] = Counter()
        self.wrong: list[str] = []
        self.worst = 0.0
        self.health: list[float] = []
        self.episodes = [self._messages(seed) for seed in range(EPISODES)]
        small = np.repeat(moving_frames(20, size=32), LONG // 20, 0)
        self.long = challenge(small, np.zeros((LONG, 8), np.float32), first=True)
        self.expected = [self._alone(messages) for messages in self.episodes]
        # Joint deltas, so that the states, which the answer is relative to, do not make the
        # difference.
        deltas = [chunks[0][1] - chunks[0][0] for chunks in self.expected]
        self.apart = min(
            float(np.abs(a - b).max()) for i, a in enumerate(deltas) for b in deltas[:i]
        )

    def _messages(self, seed: int) -> list[dict[str, Any]]:
        frames = moving_frames(10 + 16 * ROUNDS, seed=seed)
        states = np.random.default_rng(seed).uniform(-1, 1, (len(frames), 8)).astype(np.float32)
        bounds = [0, *(10 + 16 * i for i in range(ROUNDS + 1))]
        parts = [slice(a, b) for a, b in pairwise(bounds)]
        return [challenge(frames[part], states[part], first=i == 0) for i, part in enumerate(parts)]

    def _alone(self, messages: list[dict[str, Any]]) -> list[np.ndarray]:
        with self.connect() as client:
            return [client.infer(message)["actions"] for message in messages]

    def connect(self) -> Client:
        return Client(f"ws://127.0.0.1:{self.port}", timeout=120)

    def compare(self, which: int, step: int, actions: np.ndarray) -> None:
        error = float(np.abs(actions - self.expected[which][step]).max())
        self.worst = max(self.worst, error)
        self.counts["chunks compared"] += 1
        if not error <= TOLERANCE:
            self.wrong.append(f"episode {which}, request {step}: off by {error:.1e}")

    # What a client may do

    def episode(self, rng: random.Random) -> None:
        which = rng.randrange(EPISODES)
        with self.connect() as client:
            client.reset()
            for step, message in enumerate(self.episodes[which]):
                self.compare(which, step, client.infer(message)["actions"])

    def buffered_episode(self, rng: random.Random) -> None:
        which = rng.randrange(EPISODES)
        with self.connect() as client:
            client.reset()
            for step, message in enumerate(self.episodes[which]):
                front = np.stack(message["front_rgb_list"])
                state = np.array(
                    [
                        [*j, g[0]]
                        for j, g in zip(
                            message["joint_state_list"], message["gripper_state_list"], strict=True
                        )
                    ],
                    np.float32,
                )
                client.add_buffer(front, state, exec_start=len(front) - 1 if step == 0 else 0)
                view = {"observation/image": front[-1], "observation/wrist_image": front[-1]}
                reply = client.infer(
                    {**view, "observation/state": state[-1], "prompt": message["task_goal"][0]}
                )
                self.compare(which, step, reply["actions"][:16])

    def http_episode(self, rng: random.Random) -> None:
        which, name = rng.randrange(EPISODES), str(rng.randrange(6) + 10 * threading.get_ident())
        for step, message in enumerate(self.episodes[which]):
            status, body = self.post(pack(message), name)
            if status != 200:
                raise AssertionError(f"HTTP {status}: {body[:200]!r}")
            self.compare(which, step, unpack(body)["actions"])

    def post(self, body: bytes, name: str) -> tuple[int, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=120)
        connection.request("POST", "/infer", body, {"X-Session": name})
        response = connection.getresponse()
        result = response.status, response.read()
        connection.close()
        return result

    def long_first_message(self, rng: random.Random) -> None:
        with self.connect() as client:
            if client.infer(self.long)["actions"].shape != (16, 8):
                raise AssertionError("a chunk of another shape")

    def vanish(self, rng: random.Random) -> None:
        client = self.connect()
        message = self.long if rng.random() < 0.3 else self.episodes[0][0]
        data = pack(message)
        if rng.random() < 0.5:
            client._socket.send(data)
        else:  # in the middle of a message
            client._socket.socket.sendall(
                b"\x82\xff" + len(data).to_bytes(8, "big") + b"\0\0\0\0" + data[: len(data) // 2]
            )
        time.sleep(rng.random() * 0.2)
        client._socket.socket.shutdown(socket.SHUT_RDWR)
        client.close()

    def garbage(self, rng: random.Random) -> None:
        """Malformed messages by websocket and HTTP: each gets an error message, or happens to be
        well-formed.
        """
        mutations = Mutations(rng.randrange(2**32))
        for _ in range(MALFORMED):
            data = mutations.next()
            with self.connect() as client:
                client._socket.send(data)
                reply = client._socket.recv(60)
            status, body = self.post(data, "garbage")
            if (
                status >= 500
                or "Traceback" in str(reply)
                or b"Traceback" in body
                or not (reply and body)
            ):
                raise AssertionError(
                    f"{data[:100]!r} was answered with {reply[:100]!r} and HTTP {status}"
                    f" {body[:100]!r}"
                )
            self.counts["malformed messages"] += 2

    def garbage_on_the_wire(self, rng: random.Random) -> None:
        noise = rng.randbytes(2000)
        sent = rng.choice([noise, b"GET / HTTP/9\r\n\r\n", b"POST /infer HTTP/1.1\r\n\r\n"])
        with socket.create_connection(("127.0.0.1", self.port), timeout=60) as raw:
            raw.sendall(sent)
            reply = raw.recv(100)
        if not reply and sent is noise:  # what is no HTTP need not get an answer in HTTP
            self.counts["closed without an answer"] += 1
        elif not reply.startswith(b"HTTP/1.1 4"):
            raise AssertionError(f"garbage on the wire was answered with {reply!r}")

    def oversized(self, rng: random.Random) -> None:
        client = self.connect()
        try:
            client.request({"junk": b"\0" * ((MESSAGE_MIB + 1) << 20)})
        except (ConnectionError, UserError):
            return
        raise AssertionError("an oversized message was answered")

    KINDS = (
        "episode",
        "buffered_episode",
        "http_episode",
        "long_first_message",
        "vanish",
        "garbage",
        "garbage_on_the_wire",
        "oversized",
    )

    def client(self, number: int) -> None:
        rng = random.Random(number)
        while time.monotonic() < self.until:
            kind = rng.choices(self.KINDS, weights=[4, 4, 3, 1, 2, 2, 2, 1])[0]
            try:
                getattr(self, kind)(rng)
                self.counts[kind] += 1
            except Exception as error:
                self.wrong.append(f"{kind}: {type(error).__name__}: {error}")

    def watch_health(self) -> None:
        while time.monotonic() < self.until:
            begun = time.perf_counter()
            connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
            connection.request("GET", "/healthz")
            if connection.getresponse().read() != b"OK\n":
                self.wrong.append("not healthy")
            connection.close()
            self.health.append(time.perf_counter() - begun)
            time.sleep(0.2)

    def stats(self) -> dict[str, Any]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        connection.request("GET", "/stats")
        result: dict[str, Any] = json.loads(connection.getresponse().read())
        return result


def challenge(frames: np.ndarray, states: np.ndarray, first: bool) -> dict[str, Any]:
    return {
        "task_goal": ["pick up the cube"],
        "is_first_step": first,
        "front_rgb_list": list(frames),
        "wrist_rgb_list": list(frames),
        "joint_state_list": [row[:7] for row in states],
        "gripper_state_list": [np.repeat(row[7:], 2) for row in states],
    }


def resident_mib(process: int) -> float:
    status = Path(f"/proc/{process}/status").read_text()
    match = re.search(r"VmRSS:\s+(\d+)", status)
    return int(match[1]) / 1024 if match else float("nan")


def main(seconds: float) -> int:
    """Soak, print the figures; 1 if anything was not as it must be."""
    with tempfile.TemporaryDirectory() as folder:
        small_policy("framesamp_modul").save_pretrained(
            folder
        )  # open gates: memory changes actions
        return soak_server(folder, seconds)


def soak_server(checkpoint: str, seconds: float) -> int:
    """Serve a checkpoint and soak it."""
    command = [sys.executable, *COMMAND, f"checkpoint={checkpoint}"]
    server = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert server.stderr is not None
    log: list[str] = []
    for line in server.stderr:
        log.append(line)
        if "ready at" in line:
            break
    port = int(log[-1].split("127.0.0.1:")[1].split()[0])
    reader = threading.Thread(target=lambda: log.extend(server.stderr or ()), daemon=True)
    reader.start()
    soak = Soak(port, seconds)
    soak.until = time.monotonic() + seconds
    threads = [threading.Thread(target=soak.client, args=(i,)) for i in range(CLIENTS)]
    threads.append(threading.Thread(target=soak.watch_health))
    for thread in threads:
        thread.start()
    memory: list[float] = []
    while time.monotonic() < soak.until and server.poll() is None:
        memory.append(resident_mib(server.pid))
        time.sleep(1)
    for thread in threads:
        thread.join()
    time.sleep(1)
    stats = soak.stats()
    server.terminate()
    code = server.wait(60)
    reader.join(10)

    third = max(len(memory) // 3, 1)
    early, late = statistics.median(memory[third : 2 * third]), statistics.median(memory[-third:])
    health = np.percentile(soak.health, [50, 95, 100]) * 1e3
    print(machine())
    print(f"{CLIENTS} clients, {seconds:g} s:", dict(sorted(soak.counts.items())))
    print(
        f"difference from the same episode alone {soak.worst:.1e}, between episodes at least"
        f" {soak.apart:.1e}"
    )
    print("server:", json.dumps(stats))
    print("memory MiB, every 10 s:", " ".join(f"{mib:.0f}" for mib in memory[::10]))
    print(
        f"memory MiB: start {memory[0]:.0f}, median of middle third {early:.0f}, of last third"
        f" {late:.0f}"
    )
    print(
        f"/healthz while serving, ms: p50 {health[0]:.1f}, p95 {health[1]:.1f}, max {health[2]:.1f}"
    )
    print(f"exit code {code}; last words: {log[-1].strip()}")
    tracebacks = sum("Traceback" in line for line in log)
    problems = [*soak.wrong, *(["the server logged a traceback"] * tracebacks)]
    if soak.apart < 10 * TOLERANCE:
        problems.append("the known episodes have the same actions: comparing them shows nothing")
    if late > early * 1.05:
        problems.append(f"memory grew from {early:.0f} to {late:.0f} MiB")
    if code != 0 or stats["connections"] != 1 or stats["counts"].get("failed"):
        problems.append(
            f"exit code {code}, {stats['connections'] - 1} connections left, counts"
            f" {stats['counts']}"
        )
    print("\n".join(["PROBLEMS", *problems[:20], *log[-20:]]) if problems else "no problem")
    return bool(problems)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "seconds", nargs="?", type=float, default=120, help="how long the clients are at it"
    )
    raise SystemExit(main(parser.parse_args().seconds))
