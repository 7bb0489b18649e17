"""Who holds a place: hundreds of clients that never say goodbye, untrusted sources without the key,
and the silent.
"""

import re
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from helpers.serving_fakes import (
    Served,
    acted_directly,
    ask,
    challenge,
    course,
    serving_policy,
    states,
    wait_until,
)
from mme_vla.errors import UserError
from mme_vla.serving import Limits, pack, server

IMAGE = np.zeros((16, 16, 3), np.uint8)


@pytest.fixture(scope="module")
def policy():
    return serving_policy()


def test_a_websocket_that_is_closed_gets_the_reason(policy):
    with Served(policy, limits=Limits(connections=2)) as served:
        silent, other, newcomer = served.client(), served.client(), None
        other.reset()
        newcomer = served.client()
        with pytest.raises(ConnectionError, match=r"1001.*full"):
            silent.reset()
        assert other.reset() and newcomer.reset()
        silent.reconnect()
        assert silent.reset()


def test_a_silent_websocket_is_closed_and_its_episode_freed(policy):
    with Served(policy, limits=Limits(idle_s=4)) as served:
        client, steady = served.client(), served.client()
        client.infer(challenge(*course()[0], first=True))
        until = time.monotonic() + 30
        while served.server.n_clients > 1 and time.monotonic() < until:
            steady.reset()
            time.sleep(0.05)
        assert served.server.n_clients == 1
        with pytest.raises(ConnectionError, match=r"1001.*silent"):
            client.reset()
        assert steady.reset()


def open_connections(served: Served) -> set[Any]:
    assert served.server._uvicorn
    return served.server._uvicorn.server_state.connections


def idle(served: Served, count: int, request: bytes) -> list[socket.socket]:
    sockets = []
    for _ in range(count):
        raw = socket.create_connection(served.address, timeout=10)
        if request:
            raw.sendall(request)
            raw.recv(4096)
        sockets.append(raw)
    return sockets


@pytest.mark.parametrize("request_", [b"", b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n",
                                      b"GET /stats HTTP/1.1\r\nHost: x\r\n\r\n"])  # fmt: skip
def test_unauthenticated_clients_take_no_place_from_those_who_have_the_key(policy, request_):
    with Served(policy, api_key="right", limits=Limits(connections=2)) as served:
        known = served.client(api_key="right")
        sockets = idle(served, server.MAX_IDLE_CONNECTIONS + 20, request_)
        with served.client(api_key="right") as client:
            assert client.reset() and known.reset()
            assert ask(served, "GET", "/healthz")[0] == 200
        wait_until(lambda: len(open_connections(served)) <= server.MAX_IDLE_CONNECTIONS + 3)
        for raw in sockets:
            raw.close()


def test_headers_that_never_end_are_not_waited_for(policy, monkeypatch):
    monkeypatch.setattr(server, "BRIEF_S", 0.5)
    monkeypatch.setattr(server, "KEEP_ALIVE_S", 1)
    with Served(policy, limits=Limits(receive_s=1)) as served:
        sockets = idle(served, 1, b"")
        for path in (b"healthz", b"stats"):  # answered, and then the next headers never end
            sockets += idle(served, 1, b"GET /" + path + b" HTTP/1.1\r\nHost: x\r\n\r\n")
        until = time.monotonic() + 30
        while time.monotonic() < until and open_connections(served):
            for raw in sockets:
                with suppress(OSError):
                    raw.sendall(b"G")
            time.sleep(0.1)
        assert not open_connections(served)


def test_a_client_without_an_address_does_not_end_the_search_for_overdue_ones():
    """Uvicorn names no address of a connection that was reset before it was taken."""
    cut: list[Any] = []
    connections = [
        SimpleNamespace(client=client, transport=SimpleNamespace(abort=partial(cut.append, client)))
        for client in (None, ("127.0.0.1", 4000), ("127.0.0.1", 4001))
    ]
    uvicorn: Any = SimpleNamespace(server_state=SimpleNamespace(connections=connections))
    places = server.Places(Limits(), server.ServerStats())
    places.end_overdue(uvicorn)  # all get the same time
    assert not cut
    for connection in connections:
        places.deadlines[connection.client] = time.monotonic() - 1
    places.end_overdue(uvicorn)
    assert sorted(map(str, cut)) == ["('127.0.0.1', 4000)", "('127.0.0.1', 4001)", "None"]


def resident_mib() -> float:
    match = re.search(r"VmRSS:\s+(\d+)", Path("/proc/self/status").read_text())
    assert match
    return int(match[1]) / 1024


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads memory from /proc")
@pytest.mark.parametrize("path", ["/healthz", "/infer"])
def test_an_unrequested_body_is_discarded(policy, monkeypatch, path):
    monkeypatch.setattr(server, "BRIEF_S", 0.5)
    piece = bytes(2**20)
    with Served(policy, api_key="right") as served:
        before = resident_mib()
        with socket.create_connection(served.address, timeout=10) as raw:
            raw.sendall(
                f"GET {path} HTTP/1.1\r\nHost: x\r\nContent-Length: {2**30}\r\n\r\n".encode()
            )
            with pytest.raises(OSError):
                for _ in range(400):
                    raw.sendall(piece)
                    time.sleep(0.01)
        assert resident_mib() - before < 100
        assert ask(served, "GET", "/healthz")[0] == 200


def test_a_lost_http_episode_is_not_gone_on_with(policy):
    first, later = (
        pack(challenge(*part, first=index == 0)) for index, part in enumerate(course()[:2])
    )
    buffer = pack({"add_buffer": True, "images": IMAGE[None, None], "state": states(1)})
    with Served(policy, limits=Limits(connections=2)) as served:
        assert ask(served, "POST", "/infer", buffer, X_Session="a")[0] == 409, "it was never begun"
        assert ask(served, "POST", "/infer", first, X_Session="a")[0] == 200
        for other in "bc":  # two others come, and the first has to go
            assert ask(served, "POST", "/infer", first, X_Session=other)[0] == 200
        for lost in (later, buffer):
            status, _, reply = ask(served, "POST", "/infer", lost, X_Session="a")
            assert status == 409 and b"Reset and begin the episode again" in reply
        assert ask(served, "POST", "/infer", later, X_Session="c")[0] == 200
        assert ask(served, "POST", "/infer", b"garbage", X_Session="c")[0] == 400
        later_again = ask(served, "POST", "/infer", later, X_Session="c")[0]
        assert later_again == 200, "a refused request changed nothing"
        assert ask(served, "POST", "/infer", first, X_Session="c")[0] == 200


def test_one_broken_episode_does_not_fail_those_that_act_with_it(policy, monkeypatch):
    parts = course()
    expected = acted_directly(policy, parts)[0][:16]
    act = policy.act

    def brittle(episodes, steps):
        if any(episode.goal == "break" for episode in episodes):
            for episode in episodes:
                episode.draw()  # as far as the policy got
            raise ValueError("broken")
        return act(episodes, steps)

    monkeypatch.setattr(policy, "act", brittle)
    message = challenge(*parts[0], first=True)
    with Served(policy) as served:
        together = threading.Barrier(4)

        def run(number: int) -> np.ndarray | str:
            with served.client() as client:
                together.wait()
                try:
                    return client.infer(
                        {**message, **({"task_goal": "break"} if number == 0 else {})}
                    )["actions"]
                except UserError as error:
                    return str(error)

        with ThreadPoolExecutor(4) as pool:
            failure, *chunks = pool.map(run, range(4))
    assert "broken" in failure
    for chunk in chunks:
        np.testing.assert_allclose(chunk, expected, rtol=1e-4, atol=1e-5)
