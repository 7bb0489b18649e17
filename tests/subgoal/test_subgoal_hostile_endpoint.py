"""An endpoint that sends huge, compressed, slow or redirected responses: the episode continues."""

import gzip
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

from helpers.chat_server import ChatServer, chat_server, says
from helpers.subgoal_fakes import frames
from mme_vla.errors import UserError
from mme_vla.subgoal import OpenAI
from mme_vla.subgoal.base import Usage
from mme_vla.subgoal.models.api import LONGEST_REPLY, ApiFailure, make_api

pytest.importorskip("openai", reason="needs the extra openai")
SECRET = "sk-not-a-real-key"
Respond = Callable[[BaseHTTPRequestHandler], None]


@pytest.fixture(autouse=True)
def key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", SECRET)


@contextmanager
def endpoint(respond: Respond) -> Iterator[str]:
    """Serve raw responses; yield the address."""

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            with suppress(OSError):  # the client has closed the connection
                respond(self)

        def log_message(self, *args: object) -> None:
            pass

    http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    http.daemon_threads = True
    threading.Thread(target=http.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{http.server_port}/v1"
    finally:
        http.shutdown()
        http.server_close()


def send(handler: BaseHTTPRequestHandler, code: int, data: bytes, **headers: str) -> None:
    handler.send_response(code)
    for name, value in {"Content-Type": "application/json", **headers}.items():
        handler.send_header(name.replace("_", "-"), value)
    handler.send_header("Content-Length", str(len(data)))
    handler.end_headers()
    handler.wfile.write(data)


def ask(address: str, **settings: Any) -> str:
    options = {"base_url": address, "retries": 0, **settings}
    return make_api("openai", options, "subgoal", Usage()).ask("s", [("user", ["q"])]).text


def body(content: Any, **fields: Any) -> bytes:
    _, reply = says("x")
    reply["choices"][0]["message"]["content"] = content
    return json.dumps({**reply, **fields}).encode()


@pytest.fixture
def other_host() -> Iterator[ChatServer]:
    with chat_server(path=None) as server:
        server.respond = lambda request: says('{"subgoal": "follow me"}')
        yield server


@pytest.mark.parametrize("code", [301, 302, 307, 308])
def test_a_redirect_is_not_followed(other_host: ChatServer, code: int) -> None:
    def respond(handler: BaseHTTPRequestHandler) -> None:
        send(handler, code, b"", Location=f"{other_host.url}/chat/completions?k={SECRET}")

    with endpoint(respond) as address:
        with pytest.raises(ApiFailure, match=r"redirects to http.*set base_url") as caught:
            ask(address)
        predictor = OpenAI(base_url=address, retries=0)
        episode = predictor.start_episode("press")
        episode.observe(frames(1))
        assert predictor.predict([episode])[0].problem == "failed"
    assert other_host.requests == [] and SECRET not in str(caught.value)


@pytest.mark.parametrize(
    ("data", "headers", "reason"),
    [
        (body("x" * LONGEST_REPLY), {}, "longer than"),
        (gzip.compress(body("x" * 10)), {"Content_Encoding": "gzip"}, "compressed"),
        (body({"a": 1}), {}, "no text but of type dict"),
        (b"[" * 200_000 + b"]" * 200_000, {}, "RecursionError"),
        (b"<html>login</html>", {}, "JSONDecodeError"),
    ],
    ids=["huge", "compressed", "dict", "deep", "html"],
)
def test_a_response_that_is_no_answer_counts_as_failed(
    data: bytes, headers: dict[str, str], reason: str
) -> None:
    with (
        endpoint(lambda handler: send(handler, 200, data, **headers)) as address,
        pytest.raises(ApiFailure, match=reason) as caught,
    ):
        ask(address)
    assert caught.value.problem == "failed" and len(str(caught.value)) < 600


def test_an_endless_response_is_closed_at_the_limit() -> None:
    sent = []

    def respond(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.send_header("Content-Type", "application/json")
        handler.end_headers()
        while len(sent) < 1000:
            handler.wfile.write(b" " * 2**20)
            sent.append(1)

    with endpoint(respond) as address:
        with pytest.raises(ApiFailure, match="longer than"):
            ask(address)
        time.sleep(0.2)
    assert len(sent) < 100


def test_a_response_that_drips_is_given_up() -> None:
    over = threading.Event()

    def respond(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.end_headers()
        while not over.wait(0.05):
            handler.wfile.write(b" ")
            handler.wfile.flush()

    with endpoint(respond) as address:
        began = time.monotonic()
        with pytest.raises(ApiFailure, match=r"no answer within 0\.5 seconds"):
            ask(address, timeout=0.5)
        assert time.monotonic() - began < 20
        over.set()


def test_a_long_refusal_of_the_key_is_quoted_briefly_and_without_it() -> None:
    error = {"error": {"message": f"bad key {SECRET}\x1b[2J\n" + "x" * (LONGEST_REPLY // 2)}}
    huge = b"x" * (3 * LONGEST_REPLY)
    for data in (json.dumps(error).encode(), huge):
        with (
            endpoint(lambda handler, data=data: send(handler, 401, data)) as address,
            pytest.raises(UserError, match="OPENAI_API_KEY") as caught,
        ):
            ask(address)
        message = str(caught.value)
        assert len(message) < 1000 and SECRET not in message
        assert "\x1b" not in message and "\n" not in message


def test_tokens_that_are_no_count_are_left_out_and_half_a_character_is_replaced() -> None:
    usage = {"prompt_tokens": 1e308, "completion_tokens": "many"}
    with endpoint(lambda handler: send(handler, 200, body("\ud800 press", usage=usage))) as address:
        options = {"base_url": address, "retries": 0}
        reply = make_api("openai", options, "subgoal", Usage()).ask("s", [("user", ["q"])])
    assert (reply.text, reply.input_tokens, reply.output_tokens) == ("? press", 0, 0)
