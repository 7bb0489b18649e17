"""The prompted model through google-genai itself, against a local server; skipped where the extra
is not installed.
"""

import base64
import logging
from collections.abc import Iterator

import numpy as np
import pytest

from helpers.chat_server import ChatServer, chat_server
from mme_vla.subgoal import Gemini

pytest.importorskip("google.genai", reason="needs the extra gemini")
SECRET = "AIza-not-a-real-key"


def reply(text: str | None, finish: str = "STOP") -> tuple[int, dict]:
    content = {"role": "model", "parts": [] if text is None else [{"text": text}]}
    used = {
        "promptTokenCount": 300,
        "candidatesTokenCount": 20,
        "thoughtsTokenCount": 80,
        "totalTokenCount": 400,
    }
    return 200, {
        "candidates": [{"content": content, "finishReason": finish}],
        "usageMetadata": used,
    }


def failure(code: int, message: str) -> tuple[int, dict]:
    return code, {"error": {"code": code, "message": message, "status": "ERROR"}}


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[ChatServer]:
    with chat_server(path=None) as state:
        monkeypatch.setenv("GOOGLE_GEMINI_BASE_URL", state.url.removesuffix("/v1"))
        monkeypatch.setenv("GEMINI_API_KEY", SECRET)
        yield state


def test_a_conversation_over_http(server: ChatServer, caplog: pytest.LogCaptureFixture) -> None:
    server.answers = [
        failure(503, "overloaded"),
        reply('{"subgoal_sequence": ["a"], "subgoal": "press the button at <500, 250>"}'),
        reply(None, finish="SAFETY"),
        failure(500, f"internal, key={SECRET}"),
        failure(500, "internal"),
        reply('{"description": "pressed", "subgoal": "put it down"}'),
    ]
    predictor = Gemini(backoff=0, retries=1, interval=16, requests_per_minute=None)
    episode = predictor.start_episode("press", np.zeros((8, 64, 64, 3), np.uint8), "StopCube")
    subgoals = []
    episode.observe(np.zeros((1, 64, 64, 3), np.uint8))
    with caplog.at_level(logging.DEBUG):
        for _ in range(4):
            subgoals.append(predictor.predict([episode])[0])
            episode.observe(np.zeros((16, 64, 64, 3), np.uint8))
    assert [s.problem for s in subgoals] == ["", "refused", "failed", ""]
    assert [s.text for s in subgoals] == ["press the button at <128, 64>"] * 3 + ["put it down"]
    usage = predictor.usage
    assert (usage.calls, usage.retries, usage.input_tokens, usage.output_tokens) == (3, 2, 900, 300)
    first = server.requests[0]["contents"][0]["parts"]
    assert base64.b64decode(first[0]["inlineData"]["data"])[4:8] == b"ftyp" and "text" in first[2]
    assert [rotation["role"] for rotation in server.requests[-1]["contents"]] == [
        "user",
        "model",
        "user",
    ]
    assert "subgoal" in server.requests[0]["systemInstruction"]["parts"][0]["text"]
    assert SECRET not in caplog.text
