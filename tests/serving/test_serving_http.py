"""The HTTP form of the protocol on the same port, and the command that serves."""

import asyncio
import json
import logging
import re
import socket
from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest

from helpers import commands
from helpers.serving_fakes import (
    Served,
    acted_directly,
    ask,
    challenge,
    course,
    serving_policy,
    wait_until,
)
from mme_vla.cli.loading import PolicyChoice, load_policy
from mme_vla.config.composition import compose, resolved
from mme_vla.errors import UserError
from mme_vla.serving import Client, Limits, pack, unpack
from mme_vla.serving.requests import AddBuffer, Reset
from mme_vla.serving.session import NoEpisodeError

LOGGER = logging.getLogger(__name__)


def choice(words: list[str]) -> PolicyChoice:
    return PolicyChoice.from_config(resolved(compose("serve", words)))


CLOSE = {"rtol": 1e-4, "atol": 1e-5}


def stays() -> bool:
    return False


@pytest.fixture(scope="module")
def policy():
    return serving_policy()


@pytest.fixture(scope="module")
def served(policy):
    with Served(policy) as server:
        yield server


def by_http(served: Served, parts: list, **headers: str) -> list[np.ndarray]:
    status, kind, body = ask(served, "POST", "/reset", pack({"reset": True}), **headers)
    assert (status, kind) == (200, "application/msgpack") and unpack(body)["reset_finished"] is True
    chunks = []
    for index, part in enumerate(parts):
        status, _, body = ask(
            served, "POST", "/infer", pack(challenge(*part, first=index == 0)), **headers
        )
        assert status == 200, body
        chunks.append(unpack(body)["actions"])
    return chunks


def test_health_metadata_and_statistics(served):
    assert ask(served, "GET", "/healthz") == (200, "text/plain; charset=utf-8", b"OK\n")
    status, kind, body = ask(served, "GET", "/metadata")
    assert (status, kind) == (200, "application/msgpack") and unpack(body)[
        "action_space"
    ] == "joint_angle"
    before = json.loads(ask(served, "GET", "/stats")[2])["counts"]
    by_http(served, course())
    stats = json.loads(ask(served, "GET", "/stats")[2])
    assert [stats["counts"][kind] - before.get(kind, 0) for kind in ("infer", "batched")] == [3, 3]
    assert 0 < stats["latency_ms"]["infer"]["p50"] <= stats["latency_ms"]["infer"]["p95"]


def test_sessions_of_one_address_are_distinguished_by_the_header(policy, served):
    first, second = course(1), course(2)
    expected = acted_directly(policy, first)
    for index in range(3):  # the two episodes in turn
        for name, parts in (("ours", first), ("theirs", second)):
            body = pack(challenge(*parts[index], first=index == 0))
            status, _, reply = ask(served, "POST", "/infer", body, X_Session=name)
            assert status == 200
            if name == "ours":
                np.testing.assert_allclose(unpack(reply)["actions"], expected[index][:16], **CLOSE)


@pytest.mark.parametrize(
    ("method", "path", "body", "status", "message"),
    [
        ("POST", "/infer", b"", 400, b"empty"),
        ("POST", "/infer", b"garbage", 400, b"msgpack"),
        ("POST", "/infer", pack({"x": 1}), 400, b"Known"),
        ("GET", "/infer", None, 405, b"POST"),
        ("GET", "/etc/passwd", None, 404, b"healthz"),
        ("DELETE", "/healthz", None, 405, b"GET"),
        ("POST", "/infer", b"\0" * 2_000_000, 413, b"limits.message_mib"),
    ],
)
def test_wrong_requests_get_a_status_and_a_reason(policy, method, path, body, status, message):
    with Served(policy, limits=Limits(message_mib=1)) as served:
        code, kind, reply = ask(served, method, path, body)
        assert (code, kind) == (status, "text/plain; charset=utf-8")
        assert message in reply and b"Traceback" not in reply
        assert ask(served, "GET", "/healthz")[0] == 200


def test_what_the_policy_cannot_do_is_a_500(policy):
    with Served(policy) as served:
        policy.act = lambda *_: 1 / 0
        try:
            status, _, reply = ask(
                served, "POST", "/infer", pack(challenge(*course()[0], first=True))
            )
        finally:
            del policy.act
        assert status == 500 and b"ZeroDivisionError" in reply and b"Traceback" not in reply
        status, _, reply = ask(served, "POST", "/infer", pack(challenge(*course()[1], first=False)))
        assert status == 409 and b"begin the episode again" in reply, "an error ends the episode"


def test_a_key_is_requested_but_not_for_health_and_metadata(policy):
    with Served(policy, api_key="right") as served:
        for path in (
            "/healthz",
            "/metadata",
        ):  # the challenge's client requests the metadata without its key
            assert ask(served, "GET", path)[0] == 200
        for header in (None, "Api-Key wrong", "Bearer right", "Api-Key rïght"):
            assert (
                ask(served, "GET", "/stats", **({"Authorization": header} if header else {}))[0]
                == 401
            )
        assert ask(served, "GET", "/stats", Authorization="Api-Key right")[0] == 200
        assert ask(served, "POST", "/infer", b"x")[0] == 401


def test_a_page_in_a_browser_is_refused(served):
    assert (
        ask(served, "POST", "/reset", pack({"reset": True}), Origin="http://example.com")[0] == 403
    )


def slow_post(served: Served) -> socket.socket:
    raw = socket.create_connection(served.address, timeout=20)
    raw.sendall(b"POST /infer HTTP/1.1\r\nHost: x\r\nContent-Length: 100000\r\n\r\nx")
    return raw


def test_bodies_that_arrive_slowly_hold_no_place(policy):
    with Served(policy, limits=Limits(connections=2)) as served:
        bodies = [slow_post(served) for _ in range(2)]
        wait_until(lambda: served.server.n_clients == 2)
        assert served.busy == 0
        with served.client() as client, served.client() as other:
            assert client.reset() and other.reset()
        assert ask(served, "GET", "/stats")[0] == 200
        for raw in bodies:  # both were closed for the clients
            with suppress(ConnectionResetError):
                assert raw.recv(100) == b""
            raw.close()


def test_a_body_has_a_time_limit_as_a_whole(policy):
    with Served(policy, limits=Limits(receive_s=1)) as served, slow_post(served) as raw:
        raw.settimeout(0.2)
        output = b""
        for _ in range(100):  # a byte each 0.2 s: no pause reaches receive_s
            try:
                output += raw.recv(4096)
                break
            except TimeoutError:
                raw.sendall(b"x")
        assert output.startswith(b"HTTP/1.1 408")


@pytest.mark.slow
def test_silent_sessions_are_freed(policy):
    with Served(policy, limits=Limits(idle_s=4)) as served:
        by_http(served, course()[:1])
        assert len(served.server.sessions.entries) == 1
        wait_until(lambda: not served.server.sessions.entries)


@pytest.mark.parametrize(
    "sent",
    [
        b"\x16\x03\x01\x02\x00\x01",
        b"GET\r\n\r\n",
        b"A" * 100_000,
        b"POST /infer HTTP/1.1\r\nContent-Length: -4\r\n\r\n",
        b"POST /infer HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n5\r\nhello\r\n0\r\n\r\n",
        b"GET / HTTP/1.1\r\nUpgrade: websocket\r\n\r\n",
        b"GET / HTTP/1.1\r\nbroken header\r\n\r\n",
        b"POST /infer HTTP/1.1\r\nContent-Length: 100\r\n\r\ncut",
    ],
)
def test_garbage_on_the_wire_is_answered_and_harms_nobody(served, sent):
    with socket.create_connection(served.address, timeout=20) as raw:
        raw.sendall(sent)
        if not sent.endswith(b"\r\n\r\n"):
            raw.shutdown(socket.SHUT_WR)
        reply = b""
        try:
            while piece := raw.recv(4096):
                reply += piece
        except ConnectionResetError:
            pass
    assert reply.startswith(b"HTTP/1.1 4")
    assert ask(served, "GET", "/healthz")[0] == 200


@pytest.mark.slow
def test_the_command_serves_and_stops_on_request(tmp_path):
    words = ("mme_vla.serve", "model=framesamp_modul", "backbone=tiny", "port=0")
    server = commands.start(*words, env={"OMP_NUM_THREADS": "1", "MME_VLA_API_KEY": "secret"})
    try:
        lines = ""
        while "ready at ws://127.0.0.1:" not in lines and (line := server.stderr.readline()):
            lines += line
        assert "UNTRAINED" in lines
        assert "secret" not in lines
        port = int(lines.split("ready at ws://127.0.0.1:")[1].split()[0])
        with Client(f"ws://127.0.0.1:{port}", api_key="secret") as client:
            assert client.metadata["model"] == "framesamp_modul"
            assert client.infer(challenge(*course()[0], first=True))["actions"].shape == (16, 8)
            server.terminate()
            done = commands.finish(server)
        assert done.returncode == 0
        assert "stopped · 0 clients · 1 inference " in done.stderr
    finally:
        server.kill()


@pytest.mark.parametrize(
    ("words", "expected"), [([], "checkpoint="), (["checkpoint=nowhere"], "nowhere")]
)
def test_the_command_says_what_it_needs(words, expected):
    with pytest.raises(UserError, match=expected):
        load_policy(choice(words), "serve", LOGGER)


def test_the_command_loads_a_checkpoint(policy, tmp_path):
    policy.save_pretrained(tmp_path)
    loaded, name, _ = load_policy(choice([f"checkpoint={tmp_path}"]), "serve", LOGGER)
    assert name == "tokendrop_expert"
    parts = course(rounds=0)
    np.testing.assert_array_equal(
        acted_directly(loaded, parts)[0], acted_directly(policy, parts)[0]
    )


def test_a_new_session_takes_the_place_of_the_longest_silent(served):
    sessions, settings = served.server.sessions, served.server.settings
    sessions.entries.clear()
    names = [("127.0.0.1", str(i)) for i in range(settings.limits.connections)]
    newcomer = ("127.0.0.1", "new")

    async def begin():
        for name in names:
            await sessions.respond(name, Reset(), 0.0, stays)
        sessions.entries[names[0]].requests = 1  # at work
        sessions.entries[names[0]].used -= 200
        sessions.entries[names[3]].used -= 100
        await sessions.respond(newcomer, Reset(), 0.0, stays)

    served.on_loop(begin())
    assert set(sessions.entries) == {*names, newcomer} - {names[3]}
    sessions.entries.clear()


def test_a_request_that_waited_does_not_continue_with_an_episode_that_failed_meanwhile(served):
    sessions, name = served.server.sessions, ("127.0.0.1", "twice")

    async def meet():
        await sessions.respond(name, Reset(), 0.0, stays)
        entry = sessions.entries[name]
        await entry.lock.acquire()
        buffer = AddBuffer([], 0, np.zeros((0, 8), np.float32))
        waiting = asyncio.ensure_future(sessions.respond(name, buffer, 0.0, stays))
        await asyncio.sleep(0)
        assert entry.requests == 1
        entry.session.intact = False  # as an error of the request before it leaves it
        entry.lock.release()
        with pytest.raises(NoEpisodeError, match="begin the episode again"):
            await waiting

    served.on_loop(meet())
    assert name not in sessions.entries


def test_frames_are_not_taken_twice_from_a_client_that_gave_up_and_sends_them_again(policy):
    parts = course()
    with Served(policy, encode_chunk=1) as served:
        body = pack(challenge(*parts[1], first=False))
        ask(served, "POST", "/infer", pack(challenge(*parts[0], first=True)))
        with served.reading() as state, socket.create_connection(served.address) as impatient:
            head = f"POST /infer HTTP/1.1\r\nHost: x\r\nContent-Length: {len(body)}\r\n\r\n"
            impatient.sendall(head.encode() + body)
            assert state.begun.wait(30)
        status, _, reply = ask(served, "POST", "/infer", body)
        assert status == 409 and b"waited for" in reply
        np.testing.assert_allclose(
            by_http(served, parts)[0], acted_directly(policy, parts)[0][:16], **CLOSE
        )


def test_a_reset_that_waited_begins_an_episode_that_later_requests_find(served):
    sessions, name = served.server.sessions, ("127.0.0.1", "again")

    async def meet():
        await sessions.respond(name, Reset(), 0.0, stays)
        entry = sessions.entries[name]
        await entry.lock.acquire()
        waiting = asyncio.ensure_future(sessions.respond(name, Reset(), 0.0, stays))
        await asyncio.sleep(0)
        entry.session.intact = False  # as an error of the request before it leaves it
        entry.lock.release()
        assert (await waiting)["reset_finished"]
        return sessions.entries.pop(name).session.intact

    assert served.on_loop(meet())


def test_sessions_between_two_requests_count_as_clients(policy):
    with Served(policy) as served:
        for name in ("ours", "theirs"):
            by_http(served, course()[:1], X_Session=name)
        with served.client():
            stats = json.loads(ask(served, "GET", "/stats")[2])
    assert stats["connections"] == 3
    assert served.server.stats.line(served.server.n_clients).startswith("0 clients")


@pytest.mark.parametrize(
    "word",
    [
        "model=pi05",
        "policy.compute_dtype=bfloat16",
        "policy.history_dtype=float32",
        "token_budget=64",
        "+subgoal_text.kind=x",
    ],
)
def test_what_a_checkpoint_defines_cannot_be_set_beside_it(word, monkeypatch):
    overrides = SimpleNamespace(overrides=SimpleNamespace(task=["checkpoint=x", word]))
    monkeypatch.setattr("hydra.core.hydra_config.HydraConfig.initialized", lambda: True)
    monkeypatch.setattr("hydra.core.hydra_config.HydraConfig.get", lambda: overrides)
    with pytest.raises(UserError, match=f"leave out {re.escape(word)}"):
        load_policy(choice(["checkpoint=x"]), "serve", LOGGER)
