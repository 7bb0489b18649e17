"""Prompted models behind any endpoint of OpenAI's chat completions, against a local server."""

import base64
import io
import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from helpers.chat_server import ChatServer, chat_server, failure, says
from helpers.subgoal_fakes import frames
from mme_vla.errors import UserError
from mme_vla.extras.play import OpenAIPlayer
from mme_vla.subgoal import Gemini, OpenAI, build_predictor
from mme_vla.subgoal.models.api import PROVIDERS, Settings

pytest.importorskip("openai", reason="needs the extra openai")
SECRET = "sk-not-a-real-key"
ONCE = {"retries": 0}


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[ChatServer]:
    monkeypatch.setenv("OPENAI_API_KEY", SECRET)
    with chat_server() as match:
        yield match


def subgoal(text: str) -> tuple[int, dict[str, Any]]:
    return says(f'{{"description": "x", "subgoal": "{text}"}}')


def test_a_conversation_over_http(server: ChatServer, caplog: pytest.LogCaptureFixture) -> None:
    server.answers = [
        failure(503, "overloaded"),
        subgoal("press the button at <500, 250>"),
        says(None, finish="content_filter"),
        failure(500, f"internal, key={SECRET}"),
        failure(429, "slowly"),
        subgoal("put it down"),
    ]
    predictor = OpenAI(base_url=server.url, retries=1, interval=16)
    episode = predictor.start_episode("press", frames(30), "StopCube")
    episode.observe(frames(1))
    subgoals = []
    with caplog.at_level(logging.DEBUG):
        for _ in range(4):
            subgoals.append(predictor.predict([episode])[0])
            episode.observe(frames(16))
    assert [s.problem for s in subgoals] == ["", "refused", "failed", ""]
    assert [s.text for s in subgoals] == ["press the button at <128, 64>"] * 3 + ["put it down"]
    usage = predictor.usage
    assert (usage.calls, usage.input_tokens, usage.output_tokens) == (3, 900, 300)
    assert len(server.requests) == 6, "each failure that may pass is tried once more"
    assert set(server.keys) == {f"Bearer {SECRET}"} and SECRET not in caplog.text
    system, *messages = server.requests[-1]["messages"]
    assert system["role"] == "system" and "subgoal" in system["content"]
    assert [rotation["role"] for rotation in messages] == ["user", "assistant", "user"]
    assert isinstance(messages[1]["content"], str), "a model's own words go back as a text"
    assert "temperature" not in server.requests[0]


def test_a_video_is_sent_as_sampled_images(server: ChatServer) -> None:
    server.answers = [subgoal("press")]
    predictor = OpenAI(base_url=server.url, video_frames=4, temperature=0.0, **ONCE)
    episode = predictor.start_episode("press", frames(31), "StopCube")
    episode.observe(frames(1, first=200))
    predictor.predict([episode])
    content = server.requests[0]["messages"][1]["content"]
    urls = [part["image_url"]["url"] for part in content if part["type"] == "image_url"]
    assert "A video of 31 frames; 4 of them in order:" in content[0]["text"]
    pixels = [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(url.split(",")[1])))) for url in urls
    ]
    assert [int(image[0, 0, 0]) for image in pixels] == [0, 10, 20, 30, 200]
    assert server.requests[0]["temperature"] == 0.0


def test_answers_are_replayed_from_the_cache_without_a_key_or_a_server(
    server: ChatServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def first_subgoal(**where: Any) -> tuple[str | None, Any]:
        predictor = OpenAI(cache=str(tmp_path), **where, **ONCE)
        episode = predictor.start_episode("press", None, "StopCube")
        episode.observe(frames(1))
        return predictor.predict([episode])[0].text, predictor

    server.answers = [subgoal("press"), subgoal("another model's")]
    assert first_subgoal(base_url=server.url)[0] == "press"
    monkeypatch.delenv("OPENAI_API_KEY")
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "openai", None)
        text, predictor = first_subgoal()
    assert (text, predictor.usage.cached, predictor.usage.calls) == ("press", 1, 0)
    with pytest.raises(
        UserError, match=r"key in the environment variable OPENAI_API_KEY.*lacks this answer"
    ):
        first_subgoal(model="another")
    monkeypatch.setenv("OPENAI_API_KEY", SECRET)
    assert first_subgoal(base_url=server.url, model="another")[0] == "another model's"


def test_gemini_is_the_same_client_with_googles_address_and_key(
    server: ChatServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "//generativelanguage.googleapis.com/" in (PROVIDERS["gemini"].base_url or "")
    monkeypatch.setenv("GEMINI_API_KEY", "AIza-not-a-real-key")
    server.answers = [subgoal("press")]
    predictor = build_predictor({"name": "gemini", "base_url": server.url, **ONCE})
    assert isinstance(predictor, Gemini)
    episode = predictor.start_episode("press", frames(8), "StopCube")
    episode.observe(frames(1))
    assert predictor.predict([episode])[0].text == "press"
    assert server.keys == ["Bearer AIza-not-a-real-key"]
    assert server.requests[0]["model"] == "gemini-2.5-pro"
    assert server.requests[0]["temperature"] == 0.0


def test_a_key_that_google_refuses_ends_the_run(
    server: ChatServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GEMINI_API_KEY", "AIza-not-a-real-key")
    server.answers = [failure(400, "API key not valid. Please pass a valid API key.")]
    predictor = Gemini(base_url=server.url)
    episode = predictor.start_episode("press")
    episode.observe(frames(1))
    with pytest.raises(UserError, match="GEMINI_API_KEY"):
        predictor.predict([episode])
    assert len(server.requests) == 1


def test_an_endpoint_without_a_key_gets_none(
    server: ChatServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OPENAI_API_KEY")
    server.answers = [subgoal("press")]
    config = {"name": "openai", "base_url": server.url, "key_variable": None, **ONCE}
    predictor = build_predictor(config)
    assert isinstance(predictor, OpenAI)
    episode = predictor.start_episode("press")
    episode.observe(frames(1))
    assert predictor.predict([episode])[0].text == "press" and server.keys == ["Bearer none"]
    with pytest.raises(UserError, match="key_variable=null"):
        OpenAI(base_url=server.url)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"base_url": "127.0.0.1:80"}, "must be an address"),
        ({"video_frames": 3}, "an even number"),
        ({"video_frames": True}, "a whole number, 2 or more"),
        ({"temperature": -1}, "a number, 0 or more or null"),
    ],
)
def test_impossible_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        OpenAI(**settings)


def test_a_player_speaks_to_the_same_endpoints(server: ChatServer) -> None:
    options = (SimpleNamespace(label="a", action="press", needs_point=True),)
    image = np.zeros((256, 256, 3), np.uint8)
    session: Any = SimpleNamespace(
        goal="press",
        options=options,
        decisions=[],
        frame=image,
        reveals=[SimpleNamespace(frames=[image] * 6)],
    )
    server.answers = [says("I see it."), says('{"choice": "a", "point": [500, 250]}')]
    player = OpenAIPlayer(base_url=server.url, **ONCE)
    player.start(session)
    action, note = player.choose(session)
    assert action == {"choice": "a", "point": [128, 64]} and note["answers"][0] == "I see it."
    assert (player.model, player.notes()["usage"]["calls"]) == ("gpt-5-mini", 2)


def test_an_answer_that_repeats_the_key_is_kept_without_it(
    server: ChatServer, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    server.answers = [failure(500, SECRET), says(None, refusal=SECRET), subgoal(f"press {SECRET}")]
    predictor = OpenAI(base_url=server.url, cache=str(tmp_path), retries=1, interval=16)
    episode = predictor.start_episode("press", None, "StopCube")
    received = []
    with caplog.at_level(logging.DEBUG):
        for _ in range(2):
            episode.observe(frames(16))
            received.append(predictor.predict([episode])[0])
    retained = "".join(file.read_text() for file in tmp_path.rglob("*.json"))
    for text in (caplog.text, repr(received), retained):
        assert SECRET not in text
    assert "press ***" in received[1].reply and "press ***" in retained


@pytest.mark.parametrize(
    "address",
    [
        "http://me:secret-word@host/v1",
        "https://secret-word@host",
        "http://me:secret-word/2@host",
        "ftp://me:secret-word@host",
        "http://[me:secret-word@host",
        "me:secret-word@host/v1",
    ],
)
def test_an_address_with_a_login_is_refused_without_its_password(address: str) -> None:
    with pytest.raises(UserError, match=r"^base_url=… holds a user.*key_variable") as caught:
        Settings(base_url=address)
    assert "secret-word" not in str(caught.value)


def test_a_key_that_is_a_word_is_left_in_answers(
    server: ChatServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", "none")
    server.answers = [subgoal("press none of them")]
    predictor = OpenAI(base_url=server.url, **ONCE)
    episode = predictor.start_episode("press")
    episode.observe(frames(1))
    assert predictor.predict([episode])[0].text == "press none of them"
