"""Faults around the prompted model: settings, replies, cached files, interrupts."""

import json
import subprocess
import sys

import pytest

from helpers import REPOSITORY
from helpers.subgoal_fakes import frames, kinds, play, predictor_of, says, started, turns
from mme_vla.errors import UserError
from mme_vla.subgoal.models.replies import Reply, ReplyCache
from mme_vla.subgoal.threads import side_by_side


def test_late_tasks_leave_out_what_came_due_before_their_step():
    predictor, _ = predictor_of(*[says("wait")] * 4)
    episode, queries = started(predictor, "BinFill"), []
    for _ in range(7):
        queries += [episode.step] if predictor.predict([episode])[0].queried else []
        episode.observe(frames(20, episode.n_observed_frames))
    assert queries == [0, 100], (
        "the question of step 48 is left out, the one of step 96 is asked at 100"
    )


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("timeout", 0),
        ("timeout", "soon"),
        ("retries", -1),
        ("retries", 1.5),
        ("temperature", -0.1),
        ("temperature", float("nan")),
        ("video_frames", 3),
        ("workers", 0),
        ("wait", -1),
    ],
)
def test_settings_that_cannot_work_are_named(key, value):
    with pytest.raises(UserError, match=f"{key}="):
        predictor_of(**{key: value})


@pytest.mark.parametrize(
    "damage", ["", "{", "[]", '{"text": "a"}', '{"text": "a", "input_tokens": "x"}']
)
def test_a_damaged_reply_on_disk_is_requested_again(damage, tmp_path):
    first, _ = predictor_of(says("press"), cache=str(tmp_path))
    first.predict([started(first)])
    (cached,) = tmp_path.rglob("*.json")
    content = cached.read_text()
    cached.write_text(damage)
    again, client = predictor_of(says("press"), cache=str(tmp_path))
    assert again.predict([started(again)])[0].text == "press"
    assert len(client.requests) == 1 and again.usage.cached == 0 and cached.read_text() == content
    assert [path.suffix for path in tmp_path.rglob("*.*")] == [".json"]


@pytest.mark.parametrize("text", ["press", "press \ud800"])
def test_a_stored_reply_is_found_again_with_half_characters_and_further_keys(text, tmp_path):
    replies, reply = ReplyCache(tmp_path), Reply(text, 3, 4)
    replies.write("abc", reply)
    assert replies.read("abc") == reply
    path = replies.path("abc")
    stored = json.loads(path.read_text())
    del stored["crc32"]
    path.write_text(json.dumps(stored | {"model": "another"}))
    assert replies.read("abc") == reply


def test_a_reply_that_cannot_be_stored_is_used_all_the_same(tmp_path, caplog):
    first, _ = predictor_of(says("press"), cache=str(tmp_path))
    first.predict([started(first)])
    (cached,) = tmp_path.rglob("*.json")
    cached.unlink()
    cached.mkdir()
    again, _ = predictor_of(says("press"), cache=str(tmp_path))
    assert again.predict([started(again)])[0].text == "press"
    assert "cannot be written" in caplog.text
    assert list(tmp_path.rglob("*.*")) == [cached]


def test_a_clip_is_encoded_once_however_many_questions_show_it(monkeypatch):
    encoded = []

    def count(pixels):
        encoded.append(pixels.shape)
        return b"image"

    monkeypatch.setattr("mme_vla.subgoal.models.api.png_bytes", count)
    predictor, client = predictor_of(*[says("a")] * 4)
    play(predictor, started(predictor, video=10), 10)
    assert len(client.requests) == 4 and len(encoded) == 4 + 1 + 3 * 4
    last = turns(client.requests[-1])
    assert [message["role"] for message in last] == ["user", "assistant"] * 3 + ["user"]
    clip = ["video of 48", *["image"] * 4, "text"]
    assert kinds(last[2]) == kinds(last[4]) == clip


@pytest.mark.slow
def test_an_interrupt_does_not_wait_for_answers_under_way():
    code = """
import signal, threading, time, types
import numpy as np
from mme_vla.subgoal import BackgroundPredictor, Gemini

class Client:
    def create(self, **_):
        time.sleep(900)

signal.signal(signal.SIGINT, signal.default_int_handler)  # whatever the parent did with it
main = threading.main_thread().ident
client = Client()
client.chat = types.SimpleNamespace(completions=client)
gemini = Gemini(client=client)
for predictor in (gemini, BackgroundPredictor(gemini)):
    episode = predictor.start_episode("goal")
    episode.observe(np.zeros((1, 8, 8, 3), np.uint8))
    threading.Timer(0.3, signal.pthread_kill, (main, signal.SIGINT)).start()
    began = time.monotonic()
    try:
        predictor.predict([episode])
    except KeyboardInterrupt:
        print("interrupted", time.monotonic() - began < 300)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=REPOSITORY, timeout=600
    )
    assert done.stdout.split() == ["interrupted", "True"] * 2 and done.returncode == 0, done.stderr


def test_after_a_fatal_failure_no_further_question_goes_out():
    begun = []

    def call(item):
        begun.append(item)
        raise UserError("no such key")

    with pytest.raises(UserError, match="no such key"):
        side_by_side(call, range(50), 1)
    assert begun == [0]
