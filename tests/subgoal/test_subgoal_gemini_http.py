"""The prompted model through google-genai itself, against a local server; skipped where the extra is not installed."""

import base64
import json
import logging
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from mme_vla.subgoal import Gemini

pytest.importorskip("google.genai", reason="needs the extra gemini")
SECRET = "AIza-not-a-real-key"


def reply(text: str | None, finish: str = "STOP") -> tuple[int, dict]:
    content = {"role": "model", "parts": [] if text is None else [{"text": text}]}
    used = {"promptTokenCount": 300, "candidatesTokenCount": 20, "thoughtsTokenCount": 80, "totalTokenCount": 400}
    return 200, {"candidates": [{"content": content, "finishReason": finish}], "usageMetadata": used}


def failure(code: int, message: str) -> tuple[int, dict]:
    return code, {"error": {"code": code, "message": message, "status": "ERROR"}}


class Server:
    def __init__(self) -> None:
        self.answers: list[tuple[int, dict]] = []
        self.requests: list[dict] = []


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    state = Server()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            state.requests.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            code, body = state.answers.pop(0)
            data = json.dumps(body).encode()
            self.send_response(code)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, *args: object) -> None:
            pass

    http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=http.serve_forever, daemon=True).start()
    monkeypatch.setenv("GOOGLE_GEMINI_BASE_URL", f"http://127.0.0.1:{http.server_port}")
    monkeypatch.setenv("GEMINI_API_KEY", SECRET)
    yield state
    http.shutdown()


def test_a_conversation_over_http(server: Server, caplog: pytest.LogCaptureFixture) -> None:
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
    assert [rotation["role"] for rotation in server.requests[-1]["contents"]] == ["user", "model", "user"]
    assert "subgoal" in server.requests[0]["systemInstruction"]["parts"][0]["text"]
    assert SECRET not in caplog.text
