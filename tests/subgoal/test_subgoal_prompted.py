"""The prompted model behind an endpoint, against a stand-in client: conversations, failures of
every kind, cache.
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
    turns,
)
from mme_vla.errors import UserError
from mme_vla.subgoal import Gemini
from mme_vla.subgoal.base import Usage
from mme_vla.subgoal.models.api import Api, ApiFailure, Settings
from mme_vla.subgoal.prompted import system_prompt
from mme_vla.subgoal.vocabulary import VOCABULARY

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
    first, second = map(turns, client.requests)
    assert kinds(first[0]) == ["video of 10", *["image"] * 4, "image", "text"]
    assert "stop the cube" in first[0]["content"][-1]["text"]
    system = client.requests[0]["messages"][0]
    assert system["role"] == "system" and "<y, x>" in system["content"]
    assert [message["role"] for message in second] == ["user", "assistant", "user"]
    assert kinds(second[2]) == ["video of 48", *["image"] * 4, "text"]


def test_a_report_of_completion_is_no_subgoal():
    predictor, _ = predictor_of(says("press the button"), says("the task is complete"))
    subgoals, _ = play(predictor, started(predictor), 4)
    assert subgoals[3].text == "press the button" and not subgoals[3].problem


@pytest.mark.parametrize(
    ("outcome", "problem"),
    [
        (response("I would rather not"), "malformed"),
        (response(None), "empty"),
        (response(None, finish="content_filter"), "refused"),
        (response(None, refusal="No."), "refused"),
        (ApiError(503), "failed"),
        (ApiError(400, "bad image"), "failed"),
        (TimeoutError(), "failed"),
    ],
)
def test_what_goes_wrong_is_counted_and_never_ends_the_episode(outcome, problem):
    predictor, client = predictor_of(says("press"), outcome, says("lift"))
    episode = started(predictor)
    subgoals, queries = play(predictor, episode, 4)
    assert (subgoals[3].text, subgoals[3].problem) == ("press", problem)
    assert predictor.usage.problems == {problem: 1} and len(client.requests) == 2
    steps = 1 if problem != "malformed" else 3
    subgoals, queries = play(predictor, episode, steps)
    assert subgoals[-1].text == "lift" and queries == [64 if steps == 1 else 96], (
        "asked again at once if nothing was said"
    )
    assert len(turns(client.requests[-1])) == (3 if steps == 1 else 5), (
        "a question without an answer leaves no turn"
    )


def test_frames_that_a_failed_question_did_not_show_go_with_the_next():
    predictor, client = predictor_of(ApiError(400), says("press"))
    episode = started(predictor)
    play(predictor, episode, 1)
    predictor.predict([episode])
    (message,) = turns(client.requests[1])  # the question that failed is not part of it
    assert kinds(message) == ["image", "text", "video of 16", *["image"] * 4, "text"]


def test_a_slow_reply_is_abandoned():
    over = threading.Event()
    client = Client(lambda: over.wait(30))
    api = Api(Settings(timeout=0.05, retries=1), Usage(), client)
    began = time.monotonic()
    with pytest.raises(ApiFailure, match=r"no answer within 0\.1 seconds"):
        api.ask("s", [("user", ["q"])])
    assert time.monotonic() - began < 20
    over.set()


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
    predictor, _ = predictor_of(ApiError(500, leak), says("a"), cache=str(tmp_path))
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


def test_replies_are_cached_on_disk_and_not_requested_a_second_time(tmp_path):
    first, _ = predictor_of(says("press"), says("lift"), cache=str(tmp_path))
    subgoals, _ = play(first, started(first), 4)
    again, client = predictor_of(cache=str(tmp_path))
    assert [s.text for s in play(again, started(again), 4)[0]] == [s.text for s in subgoals]
    assert client.requests == [] and again.usage.cached == 2 and again.usage.calls == 0
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
    monkeypatch.setitem(sys.modules, "openai", None)
    with pytest.raises(UserError, match="extra `openai`"):
        Gemini()
    monkeypatch.delenv("GEMINI_API_KEY")
    with pytest.raises(UserError, match="environment variable GEMINI_API_KEY"):
        Gemini()


@pytest.mark.parametrize("task", [*VOCABULARY, ""])
def test_every_task_has_its_subgoals_in_the_prompt(task):
    simple, grounded = system_prompt(task, "simple"), system_prompt(task, "grounded")
    assert "<y, x>" not in simple and "@" not in simple + grounded
    assert ("<y, x>" in grounded) is (task not in ("PatternLock", "RouteStick"))
    for template in VOCABULARY.get(task, ()):
        assert template.replace("@", "") in simple
