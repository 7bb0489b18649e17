"""The prompted model behind an API, against a stand-in client: conversations, failures of every
kind, cache, cost.
"""

import logging
import sys
import threading
import time

import pytest

from helpers.subgoal_fakes import (
    ApiError,
    Client,
    kinds,
    play,
    predictor_of,
    response,
    says,
    started,
)
from mme_vla.errors import UserError
from mme_vla.subgoal import Gemini
from mme_vla.subgoal.base import Usage
from mme_vla.subgoal.gemini import VOCABULARY, gemini_system
from mme_vla.subgoal.models.api import Api, Settings

SECRET = "AIza-not-a-real-key"


@pytest.fixture(autouse=True)
def secret(monkeypatch):
    monkeypatch.setenv("GEMINI_API_KEY", SECRET)


def test_questions_come_at_their_steps_and_late_tasks_wait():
    predictor, _ = predictor_of(*[says("wait")] * 4)
    assert play(predictor, started(predictor, "StopCube"), 7)[1] == [0, 48, 96]
    predictor, _ = predictor_of(*[says("wait")] * 4)
    assert play(predictor, started(predictor, "BinFill"), 7)[1] == [0, 96]


def test_a_conversation_shows_all_that_happened_since():
    predictor, client = predictor_of(says("Press <500, 250>"), says("move <1000, 0> then <1, 999>"))
    subgoals, _ = play(predictor, started(predictor, video=10), 4)
    assert subgoals[0].text == "press <128, 64>" and subgoals[0].points == ((128, 64),)
    assert subgoals[3].text == "move <256, 0> then <0, 255>"
    (first, config), (second, _) = client.requests
    assert kinds(first[0]["parts"]) == ["video/mp4", "image/png", "text"]
    assert (
        "stop the cube" in first[0]["parts"][2]["text"] and "<y, x>" in config["system_instruction"]
    )
    assert [message["role"] for message in second] == ["user", "model", "user"]
    assert kinds(second[2]["parts"]) == ["video/mp4", "text"]


def test_a_report_of_completion_is_no_subgoal():
    predictor, _ = predictor_of(says("press the button"), says("the task is complete"))
    subgoals, _ = play(predictor, started(predictor), 4)
    assert subgoals[3].text == "press the button" and not subgoals[3].problem


@pytest.mark.parametrize(
    ("outcome", "problem", "tries"),
    [
        (response("I would rather not"), "malformed", 1),
        (response(None), "empty", 3),
        (response(None, finish="SAFETY"), "refused", 1),
        (response(None, blocked="OTHER"), "refused", 1),
        (ApiError(503), "failed", 3),
        (ApiError(400, "bad video"), "failed", 1),
        (TimeoutError(), "failed", 3),
    ],
)
def test_what_goes_wrong_is_counted_and_never_ends_the_episode(outcome, problem, tries):
    predictor, client = predictor_of(says("press"), *[outcome] * tries, says("lift"), retries=2)
    episode = started(predictor)
    subgoals, queries = play(predictor, episode, 4)
    assert (subgoals[3].text, subgoals[3].problem) == ("press", problem)
    assert predictor.usage.problems == {problem: 1} and len(client.requests) == 1 + tries
    assert predictor.usage.retries == tries - 1
    steps = 1 if problem != "malformed" else 3
    subgoals, queries = play(predictor, episode, steps)
    assert subgoals[-1].text == "lift" and queries == [64 if steps == 1 else 96], (
        "asked again at once if nothing was said"
    )
    assert len(client.requests[-1][0]) == (3 if steps == 1 else 5), (
        "a question without an answer leaves no turn"
    )


def test_frames_that_a_failed_question_did_not_show_go_with_the_next():
    predictor, client = predictor_of(ApiError(400), says("press"))
    episode = started(predictor)
    play(predictor, episode, 1)
    predictor.predict([episode])
    assert kinds(client.requests[1][0][0]["parts"]) == ["image/png", "text", "video/mp4", "text"]
    assert len(client.requests[1][0]) == 1, (
        "the question that failed is not part of the conversation"
    )


def test_a_passing_error_is_tried_again_with_growing_pauses():
    slept = []
    client = Client(ApiError(429), ApiError(500), says("press"))
    api = Api(Settings(backoff=2, requests_per_minute=None), Usage(), client, sleep=slept.append)
    assert "press" in api.ask("s", [("user", ["q"])]).text
    assert slept == [2, 4] and api.usage.retries == 2 and api.usage.calls == 1


def test_a_slow_reply_is_abandoned():
    over = threading.Event()
    client = Client(lambda: over.wait(30), says("press"))
    api = Api(Settings(timeout=0.05, backoff=0, requests_per_minute=None), Usage(), client)
    began = time.monotonic()
    assert "press" in api.ask("s", [("user", ["q"])]).text
    assert time.monotonic() - began < 20 and api.usage.retries == 1
    over.set()


def test_questions_keep_to_the_rate():
    now, slept = [0.0], []

    def sleep(seconds):
        slept.append(seconds)
        now[0] += seconds

    api = Api(
        Settings(requests_per_minute=30),
        Usage(),
        Client(*[says("a")] * 3),
        clock=lambda: now[0],
        sleep=sleep,
    )
    for _ in range(3):
        api.ask("s", [("user", ["q"])])
    assert slept == [2.0, 2.0]


@pytest.mark.parametrize(
    "error", [ApiError(401), ApiError(404), ApiError(400, "API key not valid")]
)
def test_a_key_that_is_not_accepted_ends_it_at_once(error):
    predictor, client = predictor_of(error)
    with pytest.raises(UserError, match="GEMINI_API_KEY"):
        predictor.predict([started(predictor)])
    assert len(client.requests) == 1


def test_the_key_stands_in_no_log_and_no_message(caplog, tmp_path):
    leak = f"https://host/v1?key={SECRET}"
    predictor, _ = predictor_of(
        *[ApiError(500, leak)] * 2, says("a"), retries=1, cache=str(tmp_path)
    )
    episode = started(predictor)
    with caplog.at_level(logging.DEBUG):
        assert predictor.predict([episode])[0].problem == "failed"
        predictor.predict([episode])
    with pytest.raises(UserError) as caught:
        predictor_of(ApiError(403, leak))[0].api.ask("s", [("user", ["q"])])
    content = "".join(path.read_text() for path in tmp_path.rglob("*.json"))
    assert (
        caplog.text
        and content
        and all(SECRET not in text for text in (caplog.text, str(caught.value), content))
    )
    assert "***" in caplog.text


def test_replies_are_cached_on_disk_and_cost_nothing_the_second_time(tmp_path):
    first, _ = predictor_of(says("press"), says("lift"), cache=str(tmp_path))
    subgoals, _ = play(first, started(first), 4)
    again, client = predictor_of(cache=str(tmp_path))
    assert [s.text for s in play(again, started(again), 4)[0]] == [s.text for s in subgoals]
    assert client.requests == [] and again.usage.cached == 2 and again.usage.cost == 0
    other, client = predictor_of(says("x"), cache=str(tmp_path), model="gemini-2.5-flash")
    other.predict([started(other)])
    assert len(client.requests) == 1, "another model's answers are others"


def test_episodes_are_queried_side_by_side():
    all_requested = threading.Barrier(4, timeout=30)

    def respond():
        all_requested.wait()
        return says("a")

    predictor, _ = predictor_of(*[respond] * 4)
    assert [s.text for s in predictor.predict([started(predictor) for _ in range(4)])] == ["a"] * 4
    assert predictor.usage.calls == 4


def test_without_key_or_package_it_says_what_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "google.genai", None)
    monkeypatch.setitem(sys.modules, "google", None)
    with pytest.raises(UserError, match="extra `gemini`"):
        Gemini()
    monkeypatch.delenv("GEMINI_API_KEY")
    with pytest.raises(UserError, match="environment variable GEMINI_API_KEY"):
        Gemini()


@pytest.mark.parametrize("task", [*VOCABULARY, ""])
def test_every_task_has_its_subgoals_in_the_prompt(task):
    simple, grounded = gemini_system(task, "simple"), gemini_system(task, "grounded")
    assert "<y, x>" not in simple and "@" not in simple + grounded
    assert ("<y, x>" in grounded) is (task not in ("PatternLock", "RouteStick"))
    for template in VOCABULARY.get(task, ()):
        assert template.replace("@", "") in simple
