"""A policy behind a server is driven as any other: each protocol over a real socket, by the rules
of `serving/remote`, with good and with malformed replies.
"""

import re
import threading
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import REPOSITORY
from helpers.rollout_fakes import use_inline_envs
from helpers.scripted_env import make_moving_env
from helpers.serving_fakes import Served, serving_policy
from mme_vla import UserError
from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.envs.vector.pool import Job
from mme_vla.evaluation.receipts import read_receipt
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.rollout.evaluation import RunOptions, evaluate, facts_of
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.store import read_records
from mme_vla.policy.base import Policy
from mme_vla.policy.mme import MMEPolicy
from mme_vla.serving.remote.policy import RemotePolicy
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
    evaluate(policy, jobs, folder, facts, options, evaluation)
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
    evaluate(local, jobs, tmp_path / "local", named, options, evaluation)

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
    assert part["server"]["metadata"] == {"policy": "stub"}
    assert part["server"]["times"]["requests"] == 3
    assert part["server"]["times"]["round_trip_ms"]["p50"] > 0


def test_keys_of_a_server_go_with_every_connection(
    stubs: Any, inline: None, tmp_path: Path
) -> None:
    with stubs.serving("challenge-http", stubs.Stub(key="sesame")) as url:
        policy = connect(url, api_key="sesame")
        (record,) = run(policy, tmp_path / "right", PICK[:1])
        policy.close()
        assert record.outcome == "timeout"
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
    with pytest.raises(UserError, match=r"No policy server responds.*repeat the command"):
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
