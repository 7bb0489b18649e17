"""A policy behind a server is driven as any other: each protocol over a real socket, by the rules
of `serving/remote`, with good and with malformed replies.
"""

import re
import socket
import threading
import time
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from websockets.sync.server import serve as websocket_serve

from helpers import REPOSITORY, commands
from helpers.rollout_fakes import use_inline_envs
from helpers.scripted_env import make_moving_env
from helpers.serving_fakes import Served, serving_policy
from mme_vla import UserError
from mme_vla.cli import results
from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.envs.vector.pool import Job
from mme_vla.evaluation.receipts import read_receipt
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.rollout.evaluation import EvaluationRun, RunOptions, facts_of
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.store import read_records
from mme_vla.policy.base import Policy
from mme_vla.policy.mme import MMEPolicy
from mme_vla.serving.client import Client
from mme_vla.serving.codec import pack
from mme_vla.serving.remote.connections import HarnessConnection, HttpConnection, _encode
from mme_vla.serving.remote.policy import RemotePolicy, _identity, _RefusedError
from mme_vla.serving.remote.protocols import (
    HarnessProtocol,
    LibraryProtocol,
    NewFrames,
    ServerMetadata,
)
from mme_vla.serving.remote.settings import ConnectionSettings, ServerChoice

BRIEF = ConnectionSettings(timeout_s=1, open_s=2)
VIDEO = Job("VideoUnmask", "test", 0)
PICK = [Job("PickXtimes", "test", episode) for episode in range(3)]


@pytest.fixture(autouse=True)
def stubs(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(REPOSITORY / "examples" / "servers")
    import stub_servers

    return stub_servers


@pytest.fixture
def inline(monkeypatch: pytest.MonkeyPatch) -> None:
    use_inline_envs(monkeypatch)


def run(policy: Policy, folder: Path, jobs: list[Job], **settings: Any) -> list[EpisodeRecord]:
    """Records of a rollout of the scripted environment, in order."""
    options = RolloutSettings(**{"max_steps": 40, "workers": 1, "max_batch": 1, **settings})
    facts = facts_of(policy, None, None, options, None)
    evaluation = RunOptions(base=make_moving_env, show_progress=False)
    EvaluationRun(policy, jobs, folder, facts, options, evaluation).run()
    return read_records(folder / "episodes.jsonl")


def connect(url: str, protocol: Any = "auto", **connection: Any) -> RemotePolicy:
    choice = ServerChoice(url, protocol, replace(BRIEF, **connection))
    return RemotePolicy(choice, ROBOMME_JOINT)


@pytest.mark.parametrize(
    "protocol",
    [
        "openpi",
        "robomme",
        "challenge",
        "challenge-http",
        pytest.param("harness", marks=pytest.mark.slow),  # waits until the server has said nothing
    ],
)
def test_a_server_of_each_protocol_is_recognised_and_evaluated(
    protocol: str, stubs: Any, inline: None, tmp_path: Path
) -> None:
    stub = stubs.Stub()
    with stubs.serving(protocol, stub) as url:
        policy = connect(url)
        try:
            records = run(policy, tmp_path, [VIDEO, *PICK[:1]])
        finally:
            policy.close()
    assert policy.protocol.name == protocol.removesuffix("-http")
    assert [record.outcome for record in records] == ["timeout", "timeout"]
    chunk = 1 if protocol == "harness" else 16
    assert [record.chunks for record in records] == [-(-41 // chunk)] * 2
    assert {record.model for record in records} == {policy.protocol.name}
    assert {record.checkpoint for record in records} == {"served"}
    observed = [request for request in stub.requests if "prompt" in request]
    if protocol in ("openpi", "robomme"):
        assert {request["prompt"] for request in observed} == {"pick up the red cube"}
        assert all(request["observation/state"].shape == (8,) for request in observed)


@pytest.mark.slow
@pytest.mark.parametrize(
    "protocol", ["openpi", "robomme", "challenge", "challenge-http", "harness"]
)
def test_a_stub_that_a_user_starts_is_evaluated(
    protocol: str, inline: None, tmp_path: Path
) -> None:
    file = str(REPOSITORY / "examples" / "servers" / "stub_servers.py")
    process = commands.start(file, protocol, "--port", "0")
    try:
        assert process.stdout is not None
        port = process.stdout.readline().split()[-1]
        scheme = "http" if protocol == "challenge-http" else "ws"
        policy = connect(f"{scheme}://127.0.0.1:{port}", protocol.removesuffix("-http"))
        (record,) = run(policy, tmp_path, PICK[:1])
        policy.close()
    finally:
        process.kill()
        process.communicate()
    assert record.outcome == "timeout"


def test_one_episode_at_a_time_where_the_server_may_have_one_memory(
    stubs: Any, inline: None, tmp_path: Path
) -> None:
    stub = stubs.Stub()
    with stubs.serving("robomme", stub) as url:
        policy = connect(url, "robomme")
        run(policy, tmp_path, PICK, workers=3)
        policy.close()
    resets = [i for i, request in enumerate(stub.requests) if request.get("reset")]
    assert len(resets) == 3
    lengths = [len(request["images"]) for request in stub.requests if "images" in request]
    assert lengths == [1, 16, 16] * 3, "the frames of one episode between two resets"


def test_messages_carry_the_conditioning_video_and_every_frame_once(
    stubs: Any, inline: None, tmp_path: Path
) -> None:
    buffers = stubs.Stub()
    with stubs.serving("robomme", buffers) as url:
        policy = connect(url, "robomme")
        (record,) = run(policy, tmp_path / "a", [VIDEO])
        policy.close()
    sent = [request for request in buffers.requests if "images" in request]
    assert [request["exec_start_idx"] for request in sent] == [21, 0, 0] and record.steps == 41
    assert [request["images"].shape for request in sent] == [
        (count, 1, 64, 64, 3) for count in (22, 16, 16)
    ]
    frames = [request for request in buffers.requests if "prompt" in request]
    for past, current in zip(sent, frames, strict=True):
        assert np.array_equal(past["images"][-1, 0], current["observation/image"])

    lists = stubs.Stub()
    with stubs.serving("challenge", lists) as url:
        policy = connect(url, "challenge")
        run(policy, tmp_path / "b", [VIDEO])
        policy.close()
    sent_lists = [request for request in lists.requests if "task_goal" in request]
    assert [request["is_first_step"] for request in sent_lists] == [True, False, False]
    for buffer, request in zip(sent, sent_lists, strict=True):
        assert np.array_equal(buffer["images"][:, 0], np.stack(request["front_rgb_list"]))
        assert np.array_equal(buffer["state"][:, :7], np.stack(request["joint_state_list"]))


@pytest.mark.parametrize("protocol", ["openpi", "robomme", "harness"])
def test_a_request_without_a_new_frame_shows_the_current_one_again(
    protocol: str, stubs: Any
) -> None:
    stub = stubs.Stub()
    frames = {name: np.full((1, 8, 8, 3), 77, np.uint8) for name in ROBOMME_JOINT.camera_names}
    nothing = {name: np.zeros((0, 1, 1, 3), np.uint8) for name in frames}
    state = np.full((1, 8), 0.25, np.float32)
    with stubs.serving(protocol, stub) as url:
        policy = connect(url, protocol)
        episode = policy.start_episode("go")
        episode.observe(frames, state)
        first = policy.act(episode)
        episode.observe(nothing, state[:0])
        assert np.array_equal(policy.act(episode), first) and episode.failure is None
        episode.observe(frames, state)
        policy.act(episode)
        policy.close()
    if protocol == "robomme":
        added = [request for request in stub.requests if "images" in request]
        assert len(added) == 2, "no frame is remembered twice"
    if protocol != "harness":
        requests = [request for request in stub.requests if "prompt" in request]
        assert [int(request["observation/image"].max()) for request in requests] == [77] * 3


REFUSED = {
    "error": "out of memory|refuses",
    "garbage": "malformed",
    "text": "out of memory|malformed",
    "list": "malformed",
    "no_actions": "malformed: actions are",
    "shape": r"malformed: actions have the shape",
    "nan": "malformed: actions that are not finite",
    "huge": "malformed: an action of 1e",
}
LOST = {"close": "closed the connection|No policy server responds", "silent": "No answer from"}


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["openpi", "challenge", "challenge-http", "harness"])
@pytest.mark.parametrize("fault", [*REFUSED, *LOST])
def test_a_bad_reply_ends_its_episode_with_the_reason_and_the_run_continues(
    fault: str, protocol: str, stubs: Any, inline: None, tmp_path: Path
) -> None:
    stub = stubs.Stub(fault=fault, after=1, times=1)
    with stubs.serving(protocol, stub) as url:
        policy = connect(url, protocol.removesuffix("-http"))
        records = run(policy, tmp_path, PICK, retries=0)
        policy.close()
    good = [record for record in records if record.outcome == "timeout"]
    bad = [record for record in records if record.outcome == "error"]
    if protocol == "openpi" and fault == "close":
        # A server without a memory may be asked the same once more.
        assert len(good) == 3 and not bad
        return
    assert (len(good), len(bad)) == (2, 1)
    expected = {**REFUSED, **LOST}[fault]
    if protocol == "harness" and fault in ("shape", "list"):
        expected = "malformed"
    assert bad[0].error is not None
    assert re.search(expected, bad[0].error), bad[0].error


def test_a_lost_episode_is_tried_again_and_a_refused_one_is_not(
    stubs: Any, inline: None, tmp_path: Path
) -> None:
    for fault, n_records in (("close", 4), ("nan", 3)):
        stub = stubs.Stub(fault=fault, after=1, times=1)
        with stubs.serving("challenge", stub) as url:
            policy = connect(url, "challenge")
            records = run(policy, tmp_path / fault, PICK)
            policy.close()
        assert len(records) == n_records
        assert [record.outcome for record in records].count("error") == 1


def test_a_server_that_never_gives_a_chunk_stops_the_run_with_its_reason(
    stubs: Any, inline: None, tmp_path: Path
) -> None:
    jobs = [Job("PickXtimes", "test", episode) for episode in range(12)]
    with stubs.serving("openpi", stubs.Stub(fault="shape")) as url:
        policy = connect(url, "openpi")
        with pytest.raises(UserError, match=r"no chunk in 8 episodes in a row.*\[16, 16\]"):
            run(policy, tmp_path, jobs)
        policy.close()


def test_a_run_does_not_go_on_with_another_policy_at_the_same_address(
    inline: None, tmp_path: Path
) -> None:
    with Served(serving_policy("pi05")) as served:
        policy = connect(f"ws://127.0.0.1:{served.server.port}")
        run(policy, tmp_path, PICK[:1])
        first = served.server.metadata
        for key, other in (
            ("identity", {**first["identity"], "composition": "another"}),
            ("sample_steps", first["sample_steps"] + 1),  # restarted with another flow_steps
        ):
            served.server.metadata = first | {key: other}
            with pytest.raises(UserError, match=rf"another policy than at the start .* \({key} in"):
                run(policy, tmp_path, PICK[:2])
        policy.close()
    assert len(read_records(tmp_path / "episodes.jsonl")) == 1


@pytest.mark.slow
def test_a_run_whose_server_dies_is_continued_and_nothing_is_counted_twice(
    stubs: Any, inline: None, tmp_path: Path
) -> None:
    straight, stopped = tmp_path / "straight", tmp_path / "stopped"
    with stubs.serving("challenge", stubs.Stub()) as url:
        policy = connect(url, "challenge")
        run(policy, straight, PICK)
        policy.close()

    stub = stubs.Stub()

    def dies_in_the_second_episode(stream: Any) -> np.ndarray:
        if len(stub.requests) == 7:
            server.shutdown()
            raise stubs.FaultError
        return stubs.hold_still(stream)

    stub.policy = dies_in_the_second_episode
    server = stubs.make_server("challenge", stub)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    policy = connect(f"ws://127.0.0.1:{server.socket.getsockname()[1]}", "challenge")
    with pytest.raises(UserError, match="repeat the command"):
        run(policy, stopped, PICK)
    thread.join(10)
    policy.close()
    before = read_records(stopped / "episodes.jsonl")
    assert [record.outcome for record in before] == ["timeout", "error"]

    with stubs.serving("challenge", stubs.Stub()) as url:  # at another port
        policy = connect(url, "challenge")
        after = run(policy, stopped, PICK)
        policy.close()
    assert after[: len(before)] == before
    finished = {r.key: (r.outcome, r.steps, r.actions_sha256) for r in after if r.error is None}
    assert len(after) == 4 and len(finished) == 3
    whole = read_records(straight / "episodes.jsonl")
    assert finished == {r.key: (r.outcome, r.steps, r.actions_sha256) for r in whole}


SAME_EVERYWHERE = ("seconds", "when")  # what differs between two runs of one policy


def facts(records: list[EpisodeRecord]) -> list[dict[str, Any]]:
    """All of the records, but for their times."""
    rows = []
    for record in sorted(records, key=lambda record: record.key):
        row = asdict(record)
        for name in SAME_EVERYWHERE:
            del row[name]
        rows.append(row)
    return rows


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "event"),
    [
        ("pi05", None),
        ("framesamp_modul", None),
        ("ttt_expert", None),
        ("pi05_past_actions", "pause:5@step:16+gap:3@step:32"),
        ("actions_modul", "pause:5+gap:3@step:16"),
        ("spacetime_modul", None),
    ],
)
def test_a_policy_behind_our_server_has_the_records_of_the_policy_itself(
    model: str, event: str | None, inline: None, tmp_path: Path
) -> None:
    checkpoint = tmp_path / "step_000003"
    serving_policy(model).save_pretrained(checkpoint)
    jobs = [VIDEO, *PICK]
    settings: dict[str, Any] = {"flow_steps": 2, "event": event, "workers": 2}

    local = MMEPolicy.from_pretrained(checkpoint)
    options = RolloutSettings(**{"max_steps": 40, "max_batch": 1, **settings})
    named = facts_of(local, None, str(checkpoint), options, None)
    evaluation = RunOptions(base=make_moving_env, source=str(checkpoint), show_progress=False)
    EvaluationRun(local, jobs, tmp_path / "local", named, options, evaluation).run()

    with Served(local, source=str(checkpoint), max_batch=1) as served:
        policy = connect(f"ws://127.0.0.1:{served.server.port}", timeout_s=60)
        assert policy.protocol.name == "mme_vla"
        del settings["flow_steps"]
        there = run(policy, tmp_path / "served", jobs, **settings)
        policy.close()
    here = read_records(tmp_path / "local" / "episodes.jsonl")
    assert facts(there) == facts(here)
    assert len({record.actions_sha256 for record in there}) == len(jobs)


def test_the_receipt_names_the_server_and_its_times(
    stubs: Any, inline: None, tmp_path: Path
) -> None:
    with stubs.serving("openpi", stubs.Stub()) as url:
        policy = connect(url, "openpi", name="mine", checkpoint="30000")
        records = run(policy, tmp_path, PICK[:1])
        policy.close()
    assert (records[0].model, records[0].checkpoint) == ("mine", 30000)
    (part,) = read_receipt(tmp_path / "receipt.json")["conditions"]
    assert part["server"]["address"] == url and part["server"]["protocol"] == "openpi"
    assert part["server"]["metadata"] == "{'policy': 'stub'}"
    assert part["server"]["times"]["requests"] == 3
    assert part["server"]["times"]["round_trip_ms"]["p50"] > 0


def test_results_read_the_run_of_a_served_policy(
    stubs: Any, inline: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with stubs.serving("openpi", stubs.Stub()) as url:
        policy = connect(url, "openpi", name="mine", checkpoint="30000")
        run(policy, tmp_path, PICK)
        policy.close()
    results.main([str(tmp_path)])
    printed = capsys.readouterr().out
    assert "mine" in printed and "30000" in printed and "3 of 3" in printed


@pytest.mark.parametrize("protocol", ["openpi", "challenge", "challenge-http", "harness"])
def test_the_key_of_a_server_goes_with_every_connection(
    protocol: str, stubs: Any, inline: None, tmp_path: Path
) -> None:
    with stubs.serving(protocol, stubs.Stub(key="sesame")) as url:
        policy = connect(url, protocol.removesuffix("-http"), api_key="sesame")
        (record,) = run(policy, tmp_path, PICK[:1], retries=0)
        policy.close()
    assert record.outcome == "timeout"


def test_a_wrong_key_is_reported(stubs: Any, inline: None, tmp_path: Path) -> None:
    with stubs.serving("challenge-http", stubs.Stub(key="sesame")) as url:
        policy = connect(url, api_key="wrong")
        (record,) = run(policy, tmp_path / "wrong", PICK[:1], retries=0)
        policy.close()
    assert record.error is not None and "401 the key is wrong" in record.error


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ({"server": "127.0.0.1:8000"}, r"server='127.0.0.1:8000': write ws://host:port"),
        ({"server": "http://h:1", "protocol": "openpi"}, r"protocol=openpi has websockets alone"),
        ({"server": "ws://h:1", "protocol": "grpc"}, r"protocol='grpc'"),
        ({"server": "ws://h:1", "connection": {"keyz": {}}}, r"connection.keyz"),
    ],
)
def test_a_wrong_key_of_the_command_is_named(choice: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        ServerChoice.from_config(choice)


def test_what_cannot_be_served_is_refused_before_the_first_episode(
    stubs: Any, inline: None, tmp_path: Path
) -> None:
    with pytest.raises(
        UserError, match=r"No policy server.*refused\. Start the server, then repeat"
    ):
        connect("ws://127.0.0.1:9", "openpi", open_s=0.1)
    with stubs.serving("openpi", stubs.Stub()) as url:
        with pytest.raises(UserError, match="is no server of this library"):
            connect(url, "mme_vla")
        with pytest.raises(UserError, match=r"connection\.keys are for protocol=openpi"):
            connect(url, "challenge", keys={"front": "x"})
        policy = RemotePolicy(ServerChoice(url, "openpi", BRIEF), ROBOMME_JOINT, execute=20)
        with pytest.raises(UserError, match=r"execute=20: .* returns 16 actions a chunk"):
            run(policy, tmp_path, PICK[:1], execute=20)
        policy.close()


def test_the_challenge_executes_whole_chunks(stubs: Any, inline: None, tmp_path: Path) -> None:
    def long(stream: Any) -> np.ndarray:
        return np.repeat(stream.states[-1][None], 20, axis=0)

    with stubs.serving("challenge", stubs.Stub(policy=long)) as url:
        policy = connect(url, "challenge")
        with pytest.raises(UserError, match=r"executes all of them: set execute=20"):
            run(policy, tmp_path / "a", PICK[:1])
        policy.close()
        policy = RemotePolicy(ServerChoice(url, "challenge", BRIEF), ROBOMME_JOINT, execute=20)
        (record,) = run(policy, tmp_path / "b", PICK[:1], execute=20)
        policy.close()
    assert (record.outcome, record.chunks) == ("timeout", 3)


@pytest.mark.parametrize(
    "server",
    ["ws://me:hush@h:1", "http://me:hush@h:1", "ws://h:1/?key=hush", "me:hush@h:1", "ws://h#hush"],
)
def test_an_address_with_a_secret_is_refused_and_not_repeated(server: str) -> None:
    with pytest.raises(UserError, match="MME_VLA_SERVER_KEY") as caught:
        ServerChoice(server)
    assert "hush" not in str(caught.value)


@pytest.mark.parametrize("server", ["ws://", "ws://h:port", "http://h:99999", "ftp://h:1"])
def test_an_address_without_host_or_port_is_refused(server: str) -> None:
    with pytest.raises(UserError, match=r"write ws://host:port"):
        ServerChoice(server)


def test_a_key_with_a_line_break_is_refused_and_not_repeated() -> None:
    with pytest.raises(UserError, match=r"connection\.api_key .* line break") as caught:
        ConnectionSettings(api_key="hush\n")
    assert "hush" not in str(caught.value)
    section = {"server": "ws://h:1", "connection": {"api_key": 1234}}
    choice = ServerChoice.from_config(section)
    assert choice is not None and choice.connection.api_key == "1234"


class Peer:
    """A server that writes prepared bytes to its client, and holds the connection."""

    def __init__(
        self, *parts: bytes, pause_s: float = 0, hold_s: float = 5, read: bool = True
    ) -> None:
        self.parts = parts
        self.hold_s = hold_s
        self.pause_s = pause_s
        self.read = read
        self.stop = threading.Event()
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        self.received = b""
        self.thread = threading.Thread(target=self.serve, daemon=True)

    def serve(self) -> None:
        with self.listener, suppress(OSError):
            while not self.stop.is_set():
                stream, _ = self.listener.accept()
                with stream, suppress(OSError):
                    if self.read:
                        self.received += stream.recv(65536)
                    for part in self.parts:
                        stream.sendall(part)
                        self.stop.wait(self.pause_s)
                    self.stop.wait(self.hold_s)

    def __enter__(self) -> "Peer":
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        with suppress(OSError):
            self.listener.shutdown(socket.SHUT_RDWR)
        self.thread.join(10)


@pytest.mark.slow
def test_http_waits_for_a_whole_reply_no_longer_than_its_time() -> None:
    head = b"HTTP/1.1 200 OK\r\nContent-Length: 1000000\r\n\r\n"
    for parts in ([head, *[b"x"] * 100], [b"HTTP/1.1 100 Continue\r\n\r\n"] * 100):
        with Peer(*parts, pause_s=0.1) as peer, pytest.raises(TimeoutError, match=r"within 0\.5 s"):
            HttpConnection(f"http://127.0.0.1:{peer.port}", timeout=0.5)


def test_http_takes_no_reply_that_is_cut_short_or_has_no_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("mme_vla.serving.remote.connections.LARGEST_REPLY", 1000)
    endless = Peer(b"HTTP/1.1 200 OK\r\n\r\n" + b"x" * 2000)
    with endless as peer, pytest.raises(UserError, match="malformed: more than 1,000 bytes"):
        HttpConnection(f"http://127.0.0.1:{peer.port}", timeout=60)
    with Peer(b"HTTP/1.1 200 OK\r\nContent-Length: 9\r\n\r\n\x80") as peer:
        peer.stop.set()  # closes after what it has written
        with pytest.raises(ConnectionError, match="IncompleteRead"):
            HttpConnection(f"http://127.0.0.1:{peer.port}", timeout=60)


def test_http_connects_again_where_the_server_closed_a_silent_connection() -> None:
    with Peer(b"HTTP/1.1 200 OK\r\nContent-Length: 1\r\n\r\n\x80", hold_s=0) as peer:
        connection = HttpConnection(f"http://127.0.0.1:{peer.port}", timeout=60)
        time.sleep(0.2)  # seconds of simulation
        assert connection.request({"reset": True}) == {}
        connection.close()
    assert peer.received.count(b"HTTP/1.1") == 2


def test_http_sends_the_path_of_the_address() -> None:
    with Peer(b"HTTP/1.1 200 OK\r\nContent-Length: 1\r\n\r\n\x80") as peer:
        HttpConnection(f"http://127.0.0.1:{peer.port}/policy/", timeout=60).close()
    assert peer.received.startswith(b"GET /policy/metadata HTTP/1.1")


def test_no_redirect_is_followed() -> None:
    with Peer() as other:
        place = f"//127.0.0.1:{other.port}/"
        moved = b"HTTP/1.1 302 Found\r\nContent-Length: 0\r\nLocation: %s\r\n\r\n"
        with Peer(moved % f"ws:{place}".encode()) as peer, pytest.raises(UserError):
            Client(f"ws://127.0.0.1:{peer.port}", api_key="k", open_timeout=60)
        with Peer(moved % f"http:{place}".encode()) as peer, pytest.raises(UserError, match="302"):
            HttpConnection(f"http://127.0.0.1:{peer.port}", "k", timeout=60)
    assert other.received == b""


@pytest.mark.slow
def test_a_server_that_reads_nothing_is_waited_for_no_longer_than_the_time_out() -> None:
    over = threading.Event()
    late: list[bool] = []

    def read_nothing(peer: Any) -> None:
        peer.send(pack({}))
        late.append(not over.wait(20))

    with websocket_serve(read_nothing, "127.0.0.1", 0, max_queue=1, max_size=None) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        client = Client(f"ws://127.0.0.1:{server.socket.getsockname()[1]}", timeout=1)
        for _ in range(64):  # after so many that wait, the server reads no more of the stream
            client._socket.send(b"x")
        with pytest.raises(ConnectionError, match="closed the connection"):
            client.request({"images": np.zeros((4, 2**24), np.uint8)})
        assert not late, "the server ended it"
        over.set()
        server.shutdown()
        thread.join(10)


@pytest.mark.parametrize("protocol", ["openpi", "challenge", "harness"])
def test_a_reply_above_the_limit_ends_its_episode_with_its_size_and_is_not_asked_for_again(
    protocol: str, stubs: Any, inline: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("mme_vla.serving.client.LARGEST_REPLY", 1000)
    stub = stubs.Stub(policy=lambda _: np.zeros((99, 800)))
    with stubs.serving(protocol, stub) as url:
        policy = connect(url, protocol)
        (record,) = run(policy, tmp_path, PICK[:1], retries=1)
        policy.close()
    assert record.outcome == "error"
    reason = r"malformed: frame with \d{4,} bytes exceeds limit of 1000 bytes"
    assert record.error is not None and re.search(reason, record.error), record.error


@pytest.mark.parametrize(
    "reply",
    [
        {"actions": np.full((16, 8), -(2**63))},
        {"actions": np.full((16, 8), 1e300)},
        {"actions": np.zeros((16, 8), np.bool_)},
        {"actions": np.full((16, 8), "1")},
        {"actions": [[0.0] * 8] * 16},
    ],
    ids=["least integer", "overflow", "truth values", "texts", "lists"],
)
def test_numbers_that_are_no_actions_are_refused(
    reply: dict[str, Any], stubs: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    with stubs.serving("openpi", stubs.Stub()) as url:
        policy = connect(url, "openpi")
        with pytest.raises(_RefusedError, match="malformed"):
            policy._chunk(reply)
        policy.close()


class Recorded:
    """A connection whose replies are prepared."""

    def __init__(self, *replies: Any) -> None:
        self.metadata: dict[str, Any] = {}
        self.replies = list(replies)

    def request(self, message: Any) -> Any:
        return self.replies.pop(0)

    def close(self) -> None:
        """Nothing is open."""


ARRAY = np.zeros(2)


@pytest.mark.parametrize("field", ["type", "seq", "payload"])
def test_an_array_in_place_of_a_text_is_a_malformed_reply(field: str) -> None:
    connection = HarnessConnection.__new__(HarnessConnection)
    connection.url = "ws://h:1"
    connection._timeout = 1
    message = {"type": "action", "seq": 3, "payload": {}} | {field: ARRAY}
    data = msgpack.packb(message, default=_encode)
    connection._socket = type("Socket", (), {"recv": lambda self, timeout: data})()
    with pytest.raises(UserError, match="malformed"):
        connection._reply("action", 3)


def test_metadata_of_another_kind_are_refused_or_left_out() -> None:
    choice = ServerChoice("ws://h:1", "mme_vla")
    harness = HarnessProtocol(choice, ROBOMME_JOINT)
    harness.describe(ServerMetadata.of({"observation_params": ARRAY}))
    harness.describe(ServerMetadata.of({"observation_params": {"send_subgoal": ARRAY}}))
    assert harness.subgoal is None
    params = {"send_subgoal": True, "subgoal_mode": "x" * 999}
    with pytest.raises(UserError, match="none of simple_subgoal, grounded_subgoal"):
        harness.describe(ServerMetadata.of({"observation_params": params}))
    with pytest.raises(UserError, match="is no server of this library"):
        LibraryProtocol(choice, ROBOMME_JOINT).describe(ServerMetadata.of({"server": ARRAY}))


def test_lists_of_several_lengths_are_a_malformed_action() -> None:
    harness = HarnessProtocol(ServerChoice("ws://h:1", "harness"), ROBOMME_JOINT)
    image = np.zeros((1, 2, 2, 3), np.uint8)
    frames = NewFrames(
        goal="",
        subgoal=None,
        options=(),
        views=dict.fromkeys(ROBOMME_JOINT.camera_names, image),
        states=np.zeros((1, 8), np.float32),
        current=dict.fromkeys(ROBOMME_JOINT.camera_names, image[0]),
        state=np.zeros(8, np.float32),
        n_video=0,
        executed=None,
        first=True,
        seed=0,
    )
    with pytest.raises(UserError, match="malformed: actions are"):
        harness.act(Recorded({"actions": [[1.0], [1.0, 2.0]]}), frames)


@pytest.mark.parametrize("name", ["../../elsewhere", "/etc", "..", "a/b", "x" * 101])
@pytest.mark.parametrize("key", ["model", "checkpoint"])
def test_a_servers_names_lead_out_of_no_folder(key: str, name: str) -> None:
    metadata = ServerMetadata.of({"identity": {"model": "m", "checkpoint": 3} | {key: name}})
    choice = ServerChoice("ws://h:1")
    with pytest.raises(UserError, match=r"cannot name a folder"):
        _identity(choice, "mme_vla", metadata)
    named = ConnectionSettings(name="mine", checkpoint="7")
    identity = _identity(replace(choice, connection=named), "mme_vla", metadata)
    assert (identity.model, identity.checkpoint) == ("mine", "7")


def test_a_receipt_holds_no_more_than_a_part_of_large_metadata(
    stubs: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    large = pack({str(n): {"text": "x" * 1000} for n in range(1000)})
    monkeypatch.setattr(stubs, "pack", lambda _: large)
    with stubs.serving("openpi", stubs.Stub()) as url:
        policy = connect(url, "openpi")
        policy.close()
    assert policy.info.server is not None
    assert len(policy.info.server["metadata"]) == 3999


@pytest.mark.parametrize("protocol", ["openpi", "challenge", "challenge-http"])
def test_an_interrupt_ends_requests_that_wait_for_a_reply(
    protocol: str, stubs: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    requested = threading.Event()
    release = threading.Event()
    late: list[bool] = []

    def wait_for_the_test(stream: Any) -> np.ndarray:
        requested.set()
        late.append(not release.wait(20))
        return stubs.hold_still(stream)

    def interrupt(futures: Any) -> None:
        requested.wait(5)
        raise KeyboardInterrupt

    monkeypatch.setattr("mme_vla.serving.remote.policy.wait", interrupt)
    with stubs.serving(protocol, stubs.Stub(policy=wait_for_the_test)) as url:
        policy = connect(url, protocol.removesuffix("-http"), timeout_s=60)
        episode = policy.start_episode("")
        image = np.zeros((1, 4, 4, 3), np.uint8)
        views = dict.fromkeys(ROBOMME_JOINT.camera_names, image)
        episode.observe(views, np.zeros((1, 8), np.float32))
        with pytest.raises(KeyboardInterrupt):
            policy.predict_chunk(None, [episode], {})
        policy._threads.shutdown(wait=True)
        assert not late, "the request waited for its reply"
        release.set()
