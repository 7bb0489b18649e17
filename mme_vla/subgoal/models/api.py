"""Questions to a vision-language model behind an endpoint for OpenAI's chat completions.

OpenAI, Google, vLLM, Ollama and others have such an endpoint. The package `openai` sends requests,
repeats those that failed, and limits their time. This module converts images, stores replies,
limits their size, and keeps secrets out of messages, logs and files.
"""

import base64
import hashlib
import json
import os
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlsplit

import numpy as np

from mme_vla.config.sections import NonNegative, NonNegativeInt, Positive, Range, read_section
from mme_vla.errors import UserError, brief, check_choice, missing_extra, printable, require
from mme_vla.subgoal.base import Usage
from mme_vla.subgoal.clips import sample_video
from mme_vla.subgoal.models.replies import MOST_TOKENS, Reply, ReplyCache
from mme_vla.subgoal.threads import start
from mme_vla.utils.media import png_bytes

LONGEST_REPLY = 2**20
"""Bytes of a response: many times the longest chat completion."""

_LONGEST_REASON = 500  # characters quoted of an endpoint's error
_FATAL = (401, 403, 404)  # the key or the model's name is wrong: no question will ever be answered
# Characters. A shorter secret protects nothing, such as the key `none`, and may be a word of an
# answer.
_SECRET = 8


@dataclass(frozen=True)
class Settings:
    """An endpoint, and how it is used.

    model: its name.
    base_url: address of the endpoint, such as http://127.0.0.1:8000/v1; None for OpenAI's own.
    key_variable: environment variable that holds the key; None where none is needed.
    temperature: 0 for the likeliest answer; None for models that take none.
    video_frames: images sent in place of a video, which these endpoints do not take; even, 2 or
        more.
    timeout: seconds of one try. A question is given up after `retries + 1` times as long.
    retries: further tries after an error that may pass, after pauses that the package `openai`
        chooses.
    cache: folder of replies; None stores none.
    """

    model: str = "gpt-5-mini"
    base_url: str | None = None
    key_variable: str | None = "OPENAI_API_KEY"
    temperature: NonNegative | None = None
    video_frames: Annotated[int, Range(least=2)] = 10
    timeout: Positive = 120.0
    retries: NonNegativeInt = 5
    cache: str | None = None

    def __post_init__(self) -> None:
        require(
            self.video_frames % 2 == 0,
            f"video_frames={self.video_frames} must be an even number of images, 2 or more.",
        )
        if self.base_url is None:
            return
        # Messages, logs and the client's errors name the address; this message does not.
        require(
            "@" not in self.base_url,
            "base_url=… holds a user or a password, which messages would name: write"
            " http://host:port/path alone, and set the environment variable that key_variable names"
            " to the key.",
        )
        try:
            scheme = urlsplit(self.base_url).scheme
        except ValueError:  # brackets that hold no address
            scheme = ""
        require(
            scheme in ("http", "https"),
            f"base_url={brief(self.base_url)} must be an address such as http://127.0.0.1:8000/v1,"
            " or null.",
        )

    @property
    def key(self) -> str:
        if self.key_variable is None:
            return ""
        return os.environ.get(self.key_variable, "")


PROVIDERS = {
    "openai": Settings(),
    "gemini": Settings(
        model="gemini-2.5-pro",
        base_url="https://generativelanguage.googleapis.com/v1beta/openai/",
        key_variable="GEMINI_API_KEY",
        temperature=0.0,
    ),
}
"""Default settings by name."""


@dataclass
class MediaPart:
    """An image [H, W, 3] or a video [t, H, W, 3] of a conversation, uint8.

    It is encoded once, however many questions show it.
    """

    pixels: np.ndarray
    _content: dict[int, list[dict[str, Any]]] = field(default_factory=dict)

    def content(self, video_frames: int) -> list[dict[str, Any]]:
        """Return the parts of a message: the image, or images sampled from the video."""
        if video_frames in self._content:
            return self._content[video_frames]
        if self.pixels.ndim == 3:
            parts = [_image_part(self.pixels)]
        else:
            indices = sample_video(len(self.pixels), most=video_frames)
            caption = f"A video of {len(self.pixels)} frames; {len(indices)} of them in order:"
            parts = [{"type": "text", "text": caption}]
            parts += [_image_part(self.pixels[i]) for i in indices]
        self._content[video_frames] = parts
        return parts


Message = tuple[str, Sequence[str | MediaPart]]
"""Role (`user` or `model`), and parts in order."""


class ApiFailure(Exception):  # noqa: N818  (an outcome that is expected and counted)
    """No usable answer came; `problem` is one of `empty`, `refused`, `failed`."""

    def __init__(self, problem: str, reason: str) -> None:
        super().__init__(reason)
        self.problem = problem


class Api:
    """Asks one model. Several threads may use it.

    Args:
        client: an object with openai's `chat.completions.create`. None makes one: at once, or,
            with a cache, when the first question comes that the cache does not hold.
    """

    def __init__(self, settings: Settings, usage: Usage, client: Any = None) -> None:
        self.settings = settings
        self.usage = usage
        self._lock = threading.Lock()
        self._replies = None if settings.cache is None else ReplyCache(Path(settings.cache))
        self._client = client
        if client is None and self._replies is None:
            self._client = make_client(settings)

    def ask(self, system: str, messages: Sequence[Message]) -> Reply:
        """Ask the last turn of a conversation.

        Raises:
            ApiFailure: no usable answer came, after all tries.
            UserError: the key or the model's name is not accepted.
        """
        if self._replies is None:
            return self._request(system, messages)
        digest = question_digest(self.settings, system, messages)
        stored = self._replies.read(digest)
        if stored is not None:
            with self._lock:
                self.usage.cached += 1
            return stored
        reply = self._request(system, messages)
        self._replies.write(digest, reply)
        return reply

    def _request(self, system: str, messages: Sequence[Message]) -> Reply:
        settings = self.settings
        with self._lock:
            if self._client is None:
                try:
                    self._client = make_client(settings)
                except UserError as error:
                    raise UserError(
                        f"{error} (The cache {settings.cache} lacks this answer.)"
                    ) from None
            client = self._client
        request: dict[str, Any] = {
            "model": settings.model,
            "messages": chat_messages(system, messages, settings.video_frames),
        }
        if settings.temperature is not None:
            request["temperature"] = settings.temperature

        # The client limits the time between two bytes. An endpoint that sends them slowly is given
        # up here, and its thread ends with the response.
        limit = settings.timeout * (settings.retries + 1)
        started = time.monotonic()
        call = start(lambda: client.chat.completions.create(**request))
        try:
            response = call.result(limit)
        except ApiFailure as failure:
            raise ApiFailure(failure.problem, self._quote(str(failure))) from None
        except TimeoutError:
            raise ApiFailure("failed", f"no answer within {limit:g} seconds") from None
        except Exception as error:  # whatever the network and the client raise
            raise self._failure(error) from None

        tokens = getattr(response, "usage", None)
        input_tokens = _token_count(tokens, "prompt_tokens")
        output_tokens = _token_count(tokens, "completion_tokens")
        with self._lock:
            self.usage.calls += 1
            self.usage.seconds += time.monotonic() - started
            self.usage.input_tokens += input_tokens
            self.usage.output_tokens += output_tokens
        return Reply(self._text(response), input_tokens, output_tokens)

    def _text(self, response: Any) -> str:
        """Return the text of a response, which may be of any form."""
        choices = getattr(response, "choices", None)
        choice = choices[0] if isinstance(choices, list) and choices else None
        message = getattr(choice, "message", None)
        refusal = getattr(message, "refusal", None)
        if not refusal and getattr(choice, "finish_reason", None) == "content_filter":
            refusal = "the answer was stopped: content_filter"
        if refusal:
            raise ApiFailure("refused", self._quote(str(refusal)))
        content = getattr(message, "content", None) or ""
        if not isinstance(content, str):
            raise ApiFailure(
                "failed", f"the answer is no text but of type {type(content).__name__}"
            )
        # Half a character, which JSON's escapes allow, could not be sent with the next question.
        text = content.encode("utf-8", "replace").decode().strip()
        if not text:
            raise ApiFailure("empty", "the answer is empty")
        return self._redact(text, _SECRET)

    def _failure(self, error: Exception) -> Exception:
        """Return the error to raise for one of the client: fatal, or a failure that is counted."""
        reason = f"{type(error).__name__}: {error}"
        if error.__cause__ is not None:  # "Connection error." does not say why
            reason += f" ({type(error.__cause__).__name__}: {error.__cause__})"
        code = getattr(error, "status_code", None)
        bad_key = code == 400 and "api key" in str(error).lower()
        if code in _FATAL or bad_key:
            return UserError(
                f"{self.settings.model} cannot be asked: {self._quote(reason)}. Check the key in"
                f" ${self.settings.key_variable} and the model's name."
            )
        return ApiFailure("failed", self._quote(reason))

    def _quote(self, text: str) -> str:
        """Return a text of the endpoint as messages show it: one line, short, without secrets."""
        line = printable(" ".join(self._redact(text).split()))
        return brief(line, _LONGEST_REASON, quote=False)

    def _redact(self, text: str, shortest: int = 1) -> str:
        """Replace the key, if it has at least `shortest` characters."""
        key = self.settings.key
        if len(key) < shortest:
            return text
        return text.replace(key, "***")


def make_api(
    provider: str, settings: Mapping[str, Any], where: str, usage: Usage, client: Any = None
) -> Api:
    """Make an `Api` from plain settings.

    Args:
        provider: a key of `PROVIDERS`, whose defaults hold for what `settings` does not name.
        settings: keys of `Settings`.
        where: the section they stand in, for messages.
    """
    check_choice(f"{where}.api", provider, PROVIDERS)
    values = {**asdict(PROVIDERS[provider]), **settings}
    return Api(read_section(Settings, values, where), usage, client)


def make_client(settings: Settings) -> Any:
    """Make a client of the package `openai`.

    Raises:
        UserError: the key or the package is missing.
    """
    require(
        settings.key_variable is None or settings.key,
        f"{settings.model} needs a key in the environment variable {settings.key_variable}; an"
        " endpoint that asks for none has key_variable=null.",
    )
    try:
        import openai
    except ImportError:
        raise missing_extra("An OpenAI-compatible endpoint", "openai") from None

    class LimitedClient(openai.DefaultHttpxClient):
        """Sends a request to its own address only, and reads at most `LONGEST_REPLY` bytes."""

        def send(self, request: Any, **options: Any) -> Any:
            options["stream"] = True
            response = super().send(request, **options)
            with closing(response):
                content = _read_limited(response)
            return type(response)(
                response.status_code,
                headers=response.headers,
                content=content,
                request=request,
            )

    return openai.OpenAI(
        api_key=settings.key or "none",
        base_url=settings.base_url,
        default_headers={"Accept-Encoding": "identity"},
        timeout=settings.timeout,
        max_retries=settings.retries,
        # A redirect would send the question, images included, to another host.
        http_client=LimitedClient(follow_redirects=False, timeout=settings.timeout),
    )


def _read_limited(response: Any) -> bytes:
    """Return the body of an httpx response; of an error, at most its beginning.

    Raises:
        ApiFailure: the body is compressed or too long, or is somewhere else.
    """
    if response.has_redirect_location:
        target = response.headers["location"]
        raise ApiFailure(
            "failed",
            f"the endpoint redirects to {target}, which is not followed: set base_url to the"
            " address of the endpoint itself",
        )
    encoding = response.headers.get("content-encoding", "identity")
    if encoding != "identity":  # a few bytes may unpack to any size
        raise ApiFailure("failed", f"the response is compressed ({encoding}), against the request")
    content = bytearray()
    for chunk in response.iter_raw():
        content += chunk
        if len(content) > LONGEST_REPLY:
            break
    if len(content) > LONGEST_REPLY and response.is_success:
        raise ApiFailure("failed", f"the response is longer than {LONGEST_REPLY:,} bytes")
    return bytes(content[:LONGEST_REPLY])


def chat_messages(
    system: str, messages: Sequence[Message], video_frames: int
) -> list[dict[str, Any]]:
    """Return a conversation in the form of OpenAI's chat completions."""
    converted: list[dict[str, Any]] = [{"role": "system", "content": system}]
    for role, parts in messages:
        if role == "model":
            # Many servers take an assistant's message as a text only.
            converted.append({"role": "assistant", "content": "".join(map(str, parts))})
            continue
        content: list[dict[str, Any]] = []
        for part in parts:
            if isinstance(part, MediaPart):
                content += part.content(video_frames)
            else:
                content.append({"type": "text", "text": part})
        converted.append({"role": role, "content": content})
    return converted


def question_digest(settings: Settings, system: str, messages: Sequence[Message]) -> str:
    """Return the SHA-256 of all that decides an answer.

    The address of the endpoint does not count: another machine may have the same model elsewhere.
    Of images the pixels count, not their encoding, which may differ between versions of the
    encoder.
    """
    decisive = [settings.model, settings.temperature, "openai", settings.video_frames, system]
    digest = hashlib.sha256(json.dumps(decisive).encode())
    for role, parts in messages:
        digest.update(f"\n{role}".encode())
        for part in parts:
            if isinstance(part, MediaPart):
                kind = str(part.pixels.shape)
                data = np.ascontiguousarray(part.pixels).tobytes()
            else:
                kind = "text"
                data = part.encode()
            digest.update(f"\n{kind} {len(data)} ".encode() + data)
    return digest.hexdigest()


def _token_count(usage: Any, name: str) -> int:
    """Return a number of tokens, 0 where an endpoint does not say, or sends another thing."""
    count = getattr(usage, name, None)
    if type(count) is not int or not 0 <= count < MOST_TOKENS:
        return 0
    return count


def _image_part(pixels: np.ndarray) -> dict[str, Any]:
    """pixels: [H, W, 3] uint8."""
    data = base64.b64encode(png_bytes(pixels)).decode("ascii")
    return {"type": "image_url", "image_url": {"url": f"data:image/png;base64,{data}"}}
