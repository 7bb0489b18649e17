"""A local server of a model's endpoint, such as OpenAI's chat completions, with
scripted responses.
"""

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

Reply = tuple[int, dict[str, Any]]


def says(text: str | None, finish: str = "stop", refusal: str | None = None) -> Reply:
    message = {"role": "assistant", "content": text, "refusal": refusal}
    return 200, {
        "id": "1", "object": "chat.completion", "created": 0, "model": "m",
        "choices": [{"index": 0, "message": message, "finish_reason": finish}],
        "usage": {"prompt_tokens": 300, "completion_tokens": 100, "total_tokens": 400},
    }  # fmt: skip


def failure(code: int, message: str) -> Reply:
    return code, {"error": {"message": message, "type": "error", "code": None}}


class ChatServer:
    """Returns `answers` in turn, or what `respond` makes of a request; keeps every request and its
    key.
    """

    def __init__(self) -> None:
        self.answers: list[Reply] = []
        self.respond: Callable[[dict[str, Any]], Reply] = lambda request: self.answers.pop(0)
        self.requests: list[dict[str, Any]] = []
        self.keys: list[str] = []
        self.url = ""


@contextmanager
def chat_server(path: str | None = "/v1/chat/completions") -> Iterator[ChatServer]:
    """Serve until the end of the block. path: of the requests it accepts; None for any."""
    state = ChatServer()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            request = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            state.requests.append(request)
            state.keys.append(self.headers.get("Authorization", ""))
            code, body = (
                state.respond(request) if path in (None, self.path) else failure(404, self.path)
            )
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
    state.url = f"http://127.0.0.1:{http.server_port}/v1"
    try:
        yield state
    finally:
        http.shutdown()
        http.server_close()
