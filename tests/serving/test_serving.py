"""A served policy returns what the policy itself would, to many clients at once, whatever some of
them do.
"""

import gc
import re
import socket
import threading
import time
import weakref
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from websockets.sync.client import connect

from helpers.serving_fakes import (
    Served,
    acted_directly,
    challenge,
    course,
    observation,
    serving_policy,
    states,
    wait_until,
)
from mme_vla.errors import UserError
from mme_vla.processing.base import SampleSpec
from mme_vla.serving import Client, Limits, PolicyServer, ServeSettings, pack, unpack

CLOSE = {"rtol": 1e-4, "atol": 1e-5}  # batches of other sizes add the same numbers in another order


@pytest.fixture(scope="module")
def policy():
    return serving_policy()


@pytest.fixture(scope="module")
def served(policy):
    with Served(policy) as server:
        yield server


def by_challenge(client: Client, parts: list, **more) -> list[np.ndarray]:
    assert client.reset()["reset_finished"] is True
    return [
        client.infer(challenge(*part, first=i == 0, **more))["actions"]
        for i, part in enumerate(parts)
    ]


def by_buffer(client: Client, parts: list, **more) -> list[np.ndarray]:
    assert client.reset()["reset_finished"] is True
    chunks = []
    for index, (front, wrist, state) in enumerate(parts):
        added = client.add_buffer(front, state, exec_start=len(front) - 1 if index == 0 else 0)
        assert added["add_buffer_finished"] is True and added["add_buffer_time_ms"] > 0
        reply = client.infer(observation(front[-1], wrist[-1], state[-1], **more))
        assert reply["infer_time_ms"] > 0
        chunks.append(reply["actions"])
    return chunks


@pytest.mark.parametrize("name", ["tokendrop_expert", "ttt_modul", "pi05", "pi05_past_actions"])
def test_both_schemas_give_what_the_policy_gives(name, policy):
    policy = policy if name == "tokendrop_expert" else serving_policy(name)
    parts = course(video=20)
    expected = acted_directly(policy, parts)
    with Served(policy) as served, served.client() as client:
        for chunk, reply in zip(expected, by_buffer(client, parts), strict=True):
            np.testing.assert_allclose(reply, chunk, **CLOSE)
        for chunk, reply in zip(expected, by_challenge(client, parts), strict=True):
            np.testing.assert_allclose(reply, chunk[:16], **CLOSE)
    assert not np.allclose(expected[0], expected[1], atol=1e-3)


def test_a_symbolic_policy_reads_its_kind_of_subgoal():
    policy = serving_policy("groundsg")
    parts = course(rounds=0)
    text = "pick up the cube at <3, 4>"
    expected = acted_directly(policy, parts, subgoal=text)[0]
    with Served(policy) as served, served.client() as client:
        assert client.metadata["subgoal"] == "grounded_subgoal"
        texts = {"grounded_subgoal": text, "simple_subgoal": "something else"}
        np.testing.assert_allclose(by_buffer(client, parts, **texts)[0], expected, **CLOSE)
        np.testing.assert_allclose(by_challenge(client, parts, **texts)[0], expected[:16], **CLOSE)
        assert not np.allclose(by_buffer(client, parts)[0], expected, atol=1e-4)


def test_the_client_learns_about_the_server(served):
    with served.client() as client:
        assert client.metadata["action_space"] == "joint_angle"
        assert client.metadata["model"] == "test" and client.metadata["trained"] is False
        assert (client.metadata["horizon"], client.metadata["execute"]) == (20, 16)
        assert client.infer(challenge(*course()[0], first=True))["actions"].flags.writeable


def test_many_clients_act_in_one_batch_and_get_the_numbers_they_get_alone(policy):
    courses = [course(seed) for seed in range(6)]
    expected = [acted_directly(policy, parts) for parts in courses]
    with Served(policy) as served:
        together = threading.Barrier(6)

        def run(parts: list) -> list[np.ndarray]:
            with served.client() as client:
                together.wait()
                return by_challenge(client, parts)

        with ThreadPoolExecutor(6) as pool:
            answers = list(pool.map(run, courses))
        counts = served.server.stats.counts
    for chunks, answered in zip(expected, answers, strict=True):
        for chunk, reply in zip(chunks, answered, strict=True):
            np.testing.assert_allclose(reply, chunk[:16], **CLOSE)
    assert counts["batched"] == 18
    assert counts["batch"] < 18, "nothing was batched"


def test_reset_forgets_and_a_repeated_first_request_does_not_add_up(served):
    parts = course()
    with served.client() as client:
        first = by_challenge(client, parts)
        again = by_challenge(client, parts)
        repeated = [
            client.infer(challenge(*part, first=i == 0))["actions"] for i, part in enumerate(parts)
        ]
    for chunks in (again, repeated):
        np.testing.assert_allclose(chunks, first, rtol=0, atol=0)


def test_an_episodes_memory_is_freed_when_its_client_goes(policy):
    with Served(policy) as served:
        born: list[weakref.ref] = []
        start = policy.start_episode

        def watched(*args, **options):
            episode = start(*args, **options)
            born.append(weakref.ref(episode))
            return episode

        policy.start_episode = watched
        try:
            for goodbye in ("close", "vanish"):
                client = served.client()
                by_challenge(client, course()[:1])
                if goodbye == "close":
                    client.close()
                else:
                    client._socket.socket.shutdown(socket.SHUT_RDWR)
                wait_until(lambda: served.server.n_clients == 0)
        finally:
            del policy.start_episode
        assert len(born) == 6, (
            "two connections of three episodes: at connect, reset and first request"
        )
        wait_until(lambda: gc.collect() >= 0 and all(episode() is None for episode in born))


def test_a_client_that_goes_while_its_video_is_encoded_stops_the_work(policy):
    with Served(policy, encode_chunk=1) as served, served.reading() as video:
        client = served.client()
        front = np.zeros((40, 64, 64, 3), np.uint8)
        client._socket.send(
            pack({"add_buffer": True, "images": front[:, None], "state": np.zeros((40, 8), "f4")})
        )
        assert video.begun.wait(30)
        client._socket.socket.shutdown(socket.SHUT_RDWR)
        wait_until(lambda: served.server.n_clients == 0)
        assert video.over.wait(30)
        with served.client() as other:
            by_challenge(other, course()[:1])


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (b"garbage", "not a msgpack message"),
        ("text", "binary"),
        (pack({"front_rgb_lost": 1}), "front_rgb_list"),
        (pack({"action_space": "waypoint"}), "joint_angle"),
        (pack({**observation(*(np.zeros((64, 64, 3), "f4"),) * 2, states(1)[0])}), "uint8"),
        (
            pack(
                {
                    "add_buffer": True,
                    "images": np.zeros((51, 1, 64, 64, 3), "u1"),
                    "state": states(51),
                }
            ),
            "51 frames",
        ),
        (pack(observation(*(np.zeros((64, 64, 3), "u1"),) * 2, states(1)[0])), "add_buffer"),
        (pack(challenge(*course()[0], first=False)), "is_first_step"),
    ],
)
def test_a_bad_message_is_answered_with_the_reason_and_the_connection_stays(
    policy, message, reason
):
    with Served(policy, limits=Limits(frames=50)) as served:
        with connect(f"ws://127.0.0.1:{served.server.port}", compression=None) as raw:
            raw.recv(10)
            raw.send(message)
            reply = raw.recv(10)
            assert isinstance(reply, str) and reason in reply and "Traceback" not in reply
            raw.send(pack({"reset": True}))
            assert b"reset_finished" in raw.recv(10)
        with served.client() as client:
            by_challenge(client, course()[:1])  # and others are served as before
        assert (
            served.server.stats.counts["refused"] == 1 and served.server.stats.counts["failed"] == 0
        )


def test_an_episode_cannot_outgrow_the_limit(policy):
    with Served(policy, limits=Limits(frames=30)) as served, served.client() as client:
        part = course()[1]
        client.add_buffer(part[0], part[2])
        with pytest.raises(UserError, match="32 frames"):
            client.add_buffer(part[0], part[2])
        client.reset()
        client.add_buffer(part[0], part[2])


def test_the_client_chooses_the_noise_of_an_episode(served):
    with served.client() as client:
        chunks = []
        front, wrist, state = course()[0]
        for seed in (3, 3, 4):
            client.reset(seed)
            client.add_buffer(front, state)
            chunks.append(client.infer(observation(front[-1], wrist[-1], state[-1]))["actions"])
    np.testing.assert_array_equal(chunks[0], chunks[1])
    assert not np.allclose(chunks[0], chunks[2])


def test_the_current_frame_is_not_of_the_video(served):
    front, wrist, state = course()[0]
    current = observation(front[-1], wrist[-1], state[-1])
    with served.client() as client:
        client.add_buffer(front, state, exec_start=len(front))
        with pytest.raises(UserError, match="exec_start_idx=10: it is one of the 10 frames"):
            client.infer(current)
        client.reset()
        client.add_buffer(front[:4], state[:4], exec_start=9)  # a video may come in parts
        client.add_buffer(front[4:], state[4:])
        client.infer(current)


def test_a_refused_request_leaves_the_episode_as_it_was(policy):
    """The actions are those of an episode in which the refused requests never came."""
    parts = course()[:2]
    with Served(policy) as served:
        with served.client() as client:
            expected = by_challenge(client, parts)
        with served.client() as client:
            first = by_challenge(client, parts[:1])
            small = tuple(images[:, :32] for images in parts[1][:2])
            broken = challenge(*parts[1], first=False)
            broken["joint_state_list"] = [*broken["joint_state_list"][:-1], np.full(7, 1e6)]
            for message, reason in (
                ({"front_rgb_list": 3}, "task_goal"),
                (broken, "Check the driver and the units."),
                ({**broken, "is_first_step": True}, "Check the driver and the units."),
                (challenge(*small, *parts[1][2:], first=False), "had [64, 64] before"),
            ):
                with pytest.raises(UserError, match=re.escape(reason)):
                    client.request(message)
            second = client.request(challenge(*parts[1], first=False))["actions"]
        np.testing.assert_array_equal(np.concatenate([*first, second]), np.concatenate(expected))


def test_a_state_out_of_range_costs_neither_buffer_nor_episode(policy):
    front, wrist, state = course()[0]
    broken = state.copy()
    broken[3] = 1e6
    with Served(policy) as served, served.client() as client:
        (expected,) = by_buffer(client, course()[:1])
        client.reset()
        with pytest.raises(UserError, match="1e\\+06 for number 1 of 8"):
            client.add_buffer(front, broken, exec_start=2)
        client.add_buffer(front, state, exec_start=len(front) - 1)
        with pytest.raises(UserError, match="1e\\+06 for number 1 of 8"):
            client.infer(observation(front[-1], wrist[-1], broken[3]))
        chunk = client.infer(observation(front[-1], wrist[-1], state[-1]))["actions"]
    np.testing.assert_array_equal(chunk, expected)


def test_a_request_that_failed_half_way_ends_its_connection(policy):
    with Served(policy) as served, served.client() as client:
        policy.act = lambda *_: 1 / 0
        try:
            with pytest.raises(UserError, match="ZeroDivisionError"):
                by_challenge(client, course()[:1])
        finally:
            del policy.act
        with pytest.raises(ConnectionError, match="closed the connection"):
            client.reset()


def test_an_oversized_message_closes_its_connection_alone(policy):
    with Served(policy, limits=Limits(message_mib=1)) as served, served.client() as bystander:
        with pytest.raises(ConnectionError, match=r"1009|1048576|too big|no close frame"):
            served.client().request({"junk": b"\0" * 3_000_000})
        by_challenge(bystander, course()[:1])
        wait_until(lambda: served.server.stats.counts["refused"] == 1)


def test_what_the_policy_cannot_do_fails_for_its_client_without_a_traceback(policy):
    with Served(policy) as served, served.client() as client:
        act = policy.act
        policy.act = lambda *_: 1 / 0
        try:
            with pytest.raises(UserError, match="ZeroDivisionError") as caught:
                by_challenge(client, course()[:1])
        finally:
            policy.act = act
            del policy.act
        assert "Traceback" not in str(caught.value)
        client.reconnect()
        by_challenge(client, course()[:1])


def test_a_key_is_requested(policy):
    with Served(policy, api_key="right") as served:
        for key in (None, "wrong", "righ", "right2"):
            with pytest.raises(UserError, match="Api-Key"):
                served.client(api_key=key)
        with served.client(api_key="right") as client:
            by_challenge(client, course()[:1])


def test_messages_name_an_address_without_its_user_and_password(policy, monkeypatch):
    with Served(policy) as served:
        port = served.server.port
        with Client(f"ws://me:secret@127.0.0.1:{port}", timeout=60) as client:

            def say_nothing(timeout):
                raise TimeoutError

            monkeypatch.setattr(client._socket, "recv", say_nothing)
            with pytest.raises(TimeoutError, match=r"ws://…@127") as silent:
                client.request({"reset": True})
    messages = [str(silent.value)]
    for url in (
        f"ws://me:secret@127.0.0.1:{port}",  # it has stopped
        "ws://me:se@cret@127.0.0.1:x",
        "ws://me:cret/@127.0.0.1",
        "me:secret@127.0.0.1",
        "http://me:secret@127.0.0.1",
    ):
        with pytest.raises((UserError, ConnectionError)) as refused:
            Client(url, open_timeout=5)
        messages.append(str(refused.value))
    assert not any("cret" in message or "me:" in message for message in messages), messages


def test_a_full_server_says_so_and_has_capacity_again_later(policy):
    with Served(policy, encode_chunk=1, limits=Limits(connections=1)) as served, served.reading():
        busy = served.client()
        front = np.zeros((40, 64, 64, 3), np.uint8)
        busy._socket.send(
            pack({"add_buffer": True, "images": front[:, None], "state": np.zeros((40, 8), "f4")})
        )
        wait_until(lambda: served.busy == 1)
        with pytest.raises(UserError, match="full"):
            served.client()
        busy._socket.socket.shutdown(socket.SHUT_RDWR)
        wait_until(lambda: served.server.n_clients == 0)
        served.client().close()


def test_a_client_that_takes_no_answers_is_cut_off_and_delays_nobody(policy):
    with Served(policy, limits=Limits(send_s=2)) as served:
        for listening in served.server._uvicorn.servers[0].sockets:
            # so that little has to go unread
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        slow = socket.create_connection(served.address)
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.sendall(
            b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection:"
            b" Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key:"
            b" dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        )
        assert slow.recv(12) == b"HTTP/1.1 101"
        reset = pack({"reset": True})
        frame = b"\x82" + bytes([0x80 | len(reset)]) + b"\0\0\0\0" + reset
        slow.setblocking(False)
        flooding = threading.Event()

        def flood() -> None:
            while not flooding.is_set():
                try:
                    slow.send(frame * 200)  # thousands of requests, and not one answer is read
                except BlockingIOError:
                    time.sleep(0.01)
                except OSError:
                    return

        thread = threading.Thread(target=flood)
        thread.start()
        with served.client() as client:
            by_challenge(client, course())
        wait_until(lambda: served.server.stats.counts["too_slow"] == 1, 30)
        flooding.set()
        thread.join()
        slow.close()


def test_a_long_video_does_not_keep_others_waiting(policy):
    with (
        Served(policy, encode_chunk=1) as served,
        served.client() as watcher,
        served.client() as other,
        ThreadPoolExecutor(1) as pool,
    ):
        front = np.zeros((40, 64, 64, 3), np.uint8)
        video = challenge(front, front, np.zeros((40, 8), np.float32), first=True)
        with served.reading() as reading:
            pending = pool.submit(watcher.infer, video)
            assert reading.begun.wait(30)
            by_challenge(other, course())  # within its client's time limit
            assert not pending.done()
        assert pending.result(60)["actions"].shape == (16, 8)


def test_stopping_finishes_what_is_running_and_says_goodbye(policy):
    served = Served(policy, encode_chunk=1)
    with served, ThreadPoolExecutor(2) as pool:
        busy, idle = served.client(), served.client()
        busy.reset()
        # the answer to the reset comes before the server rests
        wait_until(lambda: served.busy == 0)
        front = np.zeros((40, 64, 64, 3), np.uint8)
        with served.reading():
            pending = pool.submit(
                busy.infer, challenge(front, front, np.zeros((40, 8), np.float32), first=True)
            )
            wait_until(lambda: served.busy == 1)
            stopped = pool.submit(served.on_loop, served.server.stop())
            wait_until(lambda: served.server.places.stopping)
        stopped.result(60)
        assert pending.result(60)["actions"].shape == (16, 8)
        for client in (idle, busy):
            with pytest.raises(ConnectionError, match=r"1001.*stopping"):
                client.reset()
        with pytest.raises(ConnectionError, match="No policy server responds"):
            served.client()


def test_settings_and_policies_that_cannot_work_are_refused(policy):
    for bad, message in (
        ({"port": 70000}, "port=70000 must be a whole number from 0 to 65535"),
        ({"action_space": "joints"}, "action_space='joints'. Known: ee_delta"),
        ({"api_key": " x"}, "without blanks"),
        ({"execute": 0}, "a whole number, 1 or more or null"),
        ({"max_batch": 1.5}, "a whole number"),
        ({"limits": {"send_s": -1}}, "limits.send_s=-1 must be a number above 0"),
    ):
        with pytest.raises(UserError, match=message):
            ServeSettings.from_dict(bad)
    unknowing = serving_policy()
    unknowing.require_processor().stats = None
    with pytest.raises(UserError, match="statistics"):
        PolicyServer(unknowing, ServeSettings())
    with pytest.raises(UserError, match="returns joint_angle"):
        PolicyServer(policy, ServeSettings(action_space="ee_pose"))
    with (
        Served(policy) as first,
        pytest.raises(UserError, match="Cannot listen"),
        Served(policy, port=first.server.port),
    ):
        pass


def test_past_actions_need_the_frames_they_led_to():
    with Served(serving_policy("pi05_past_actions")) as served, served.client() as client:
        front, wrist, state = course()[0]
        request = observation(front[-1], wrist[-1], state[-1])
        client.infer(request)
        with pytest.raises(UserError, match="add_buffer"):
            client.infer(request)


def test_frames_that_follow_each_other_are_not_made_of_single_observations(monkeypatch):
    policy = serving_policy("pi05")
    monkeypatch.setattr(policy.require_processor(), "samples", SampleSpec(window=2))
    front, wrist, state = course()[0]
    with Served(policy) as served, served.client() as client:
        with pytest.raises(UserError, match=r"last 2 frames .*_rgb_list"):
            client.infer(observation(front[-1], wrist[-1], state[-1]))
        client.infer(challenge(front, wrist, state, first=True))


def test_unpacked_metadata_is_the_first_message(served):
    with connect(f"ws://127.0.0.1:{served.server.port}/any/path", compression=None) as raw:
        assert unpack(raw.recv(10))["server"] == "mme_vla"
        raw.send(pack({"reset": True}))
        assert unpack(raw.recv(10))["reset_finished"] is True
