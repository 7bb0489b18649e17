"""Questions to a model behind an API: retries, rate limit, time limit, cache of answers, cost. No secret is logged."""

import hashlib
import json
import logging
import math
import os
import threading
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.errors import UserError, missing_extra
from mme_vla.files import read_json, sealed, unsealed
from mme_vla.media import film_bytes, png_bytes
from mme_vla.subgoal.base import Usage
from mme_vla.subgoal.clips import ENCODING
from mme_vla.subgoal.models.threads import within

log = logging.getLogger(__name__)
Turn = tuple[str, list[Any]]  # role; parts: texts, pictures [H, W, 3], videos [t, H, W, 3], bare or as `Shown`

_PASSING = (408, 429, 500, 502, 503, 504)  # HTTP: worth another try
_FATAL = (401, 403, 404)  # the key or the model's name is wrong: no question will ever be answered
_LONGEST_PAUSE = 60.0  # seconds


@dataclass(frozen=True)
class Settings:
    """How the API is used.

    model: its name. key_variable: environment variable that holds the key.
    temperature: 0 for the likeliest answer. timeout: seconds before an answer is given up.
    retries: further tries after a passing error. backoff: seconds before the first of them, doubled each time.
    requests_per_minute: rate limit; None for none. cache: folder of answers; None keeps none.
    input_price, output_price: US dollars for a million tokens.
    """

    model: str = "gemini-2.5-pro"
    key_variable: str = "GEMINI_API_KEY"
    temperature: float = 0.0
    timeout: float = 120.0
    retries: int = 5
    backoff: float = 2.0
    requests_per_minute: float | None = 60
    cache: str | None = None
    input_price: float = 1.25
    output_price: float = 10.0

    def __post_init__(self) -> None:
        for name, wanted in _WANTED.items():
            value = getattr(self, name)
            if name == "requests_per_minute" and value is None:
                continue
            usable = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
            if not usable or value < 0 or (value == 0 and "above" in wanted):
                raise UserError(f"{name}={value!r} must be {wanted}.")
        if not isinstance(self.retries, int):
            raise UserError(f"retries={self.retries!r} must be a whole number, 0 or more.")


_WANTED = {
    "temperature": "a number, 0 or more",
    "timeout": "a number of seconds above 0",
    "retries": "a whole number, 0 or more",
    "backoff": "a number of seconds, 0 or more",
    "requests_per_minute": "a number above 0, or null for no limit",
    "input_price": "a number of dollars, 0 or more",
    "output_price": "a number of dollars, 0 or more",
}


class Shown:
    """A picture [H, W, 3] or video [t, H, W, 3] of a conversation, encoded once however many questions show it."""

    def __init__(self, pixels: np.ndarray) -> None:
        self.pixels = pixels

    @cached_property
    def part(self) -> Mapping[str, Any]:
        """What is sent."""
        picture = self.pixels.ndim == 3
        data = png_bytes(self.pixels) if picture else film_bytes(self.pixels, **ENCODING)
        return {"inline_data": {"mime_type": "image/png" if picture else "video/mp4", "data": data}}


@dataclass(frozen=True)
class Reply:
    """A usable answer and the tokens it took; thoughts count as output."""

    text: str
    input_tokens: int
    output_tokens: int


class ApiFailure(Exception):  # noqa: N818  (an outcome that is expected and counted)
    """No usable answer came; `problem` is one of `empty`, `refused`, `failed`."""

    def __init__(self, problem: str, reason: str) -> None:
        super().__init__(reason)
        self.problem = problem


@dataclass
class Api:
    """One connection. Safe to use from several threads.

    client: an object with `models.generate_content(model=, contents=, config=)`, as google-genai's; None makes one.
    clock, sleep: of the rate limit and the pauses.
    """

    settings: Settings
    usage: Usage
    client: Any = None
    clock: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _next: float = 0.0

    def __post_init__(self) -> None:
        if self.client is None:
            self.client = _make_client(self.settings)

    def ask(self, system: str, turns: Sequence[Turn]) -> Reply:
        """Ask the last turn of a conversation.

        Raises:
            ApiFailure: no usable answer came, after all tries.
            UserError: the key or the model's name is not accepted.
        """
        known = self._cache_file(system, turns)
        if known is not None and (kept := _read_reply(known)) is not None:
            with self._lock:
                self.usage.cached += 1
            return kept
        reply = self._tried(system, turns)
        if known is not None:
            known.parent.mkdir(parents=True, exist_ok=True)
            draft = known.with_suffix(f".{uuid.uuid4().hex}.partial")  # other processes may share the folder
            draft.write_text(json.dumps(sealed(vars(reply))))
            try:
                draft.replace(known)
            except OSError as error:  # a folder in its place: the answer counts, it is only not kept
                draft.unlink(missing_ok=True)
                log.warning("%s cannot be written: %s", known, error.strerror)
        return reply

    def _tried(self, system: str, turns: Sequence[Turn]) -> Reply:
        contents = [{"role": role, "parts": [_part(part) for part in parts]} for role, parts in turns]
        config = {"system_instruction": system, "temperature": self.settings.temperature}
        pause = self.settings.backoff
        failure = ApiFailure("failed", "never asked")
        for attempt in range(self.settings.retries + 1):
            if attempt:
                with self._lock:
                    self.usage.retries += 1
                self.sleep(min(pause, _LONGEST_PAUSE))
                pause *= 2
            self._wait_for_turn()
            try:
                return self._once(contents, config)
            except ApiFailure as error:
                failure = error
                if error.problem == "refused":
                    break
            except Exception as error:  # whatever the network and the client come up with
                reason = self._without_key(f"{type(error).__name__}: {error}")
                if self._is_fatal(error):
                    raise UserError(
                        f"{self.settings.model} cannot be asked: {reason}. Check the key in "
                        f"${self.settings.key_variable} and the model's name."
                    ) from None
                failure = ApiFailure("failed", reason)
                if not _is_passing(error):
                    break
            log.info("%s: try %d came to nothing (%s)", self.settings.model, attempt + 1, failure)
        raise failure

    def _once(self, contents: list[Any], config: dict[str, Any]) -> Reply:
        started = self.clock()
        call = self.client.models.generate_content
        response = within(
            self.settings.timeout, lambda: call(model=self.settings.model, contents=contents, config=config)
        )
        used = getattr(response, "usage_metadata", None)
        read, written = _count(used, "prompt_token_count"), _count(used, "candidates_token_count")
        written += _count(used, "thoughts_token_count")
        with self._lock:
            self.usage.calls += 1
            self.usage.seconds += self.clock() - started
            self.usage.input_tokens += read
            self.usage.output_tokens += written
            self.usage.cost += (read * self.settings.input_price + written * self.settings.output_price) / 1e6
        if refusal := _refusal(response):
            raise ApiFailure("refused", refusal)
        text = (getattr(response, "text", None) or "").strip()
        if not text:
            raise ApiFailure("empty", "the answer is empty")
        return Reply(text, read, written)

    def _wait_for_turn(self) -> None:
        if self.settings.requests_per_minute is None:
            return
        with self._lock:
            start = max(self.clock(), self._next)
            self._next = start + 60 / self.settings.requests_per_minute
        if (wait := start - self.clock()) > 0:
            self.sleep(wait)

    def _cache_file(self, system: str, turns: Sequence[Turn]) -> Path | None:
        if self.settings.cache is None:
            return None
        digest = hashlib.sha256(json.dumps([self.settings.model, self.settings.temperature, system]).encode())
        for role, parts in turns:
            digest.update(f"\n{role}".encode())
            for shown in parts:
                part = shown.pixels if isinstance(shown, Shown) else shown
                # The pictures themselves, not their encoding, which may differ between versions of the encoder.
                raw = part.encode() if isinstance(part, str) else np.ascontiguousarray(part).tobytes()
                digest.update(f"\n{getattr(part, 'shape', 'text')} {len(raw)} ".encode() + raw)
        name = digest.hexdigest()
        return Path(self.settings.cache) / name[:2] / f"{name}.json"

    def _without_key(self, text: str) -> str:
        key = os.environ.get(self.settings.key_variable, "")
        return text.replace(key, "***") if key else text

    def _is_fatal(self, error: Exception) -> bool:
        return _code(error) in _FATAL or (_code(error) == 400 and "api key" in str(error).lower())


def _make_client(settings: Settings) -> Any:
    key = os.environ.get(settings.key_variable)
    if not key:
        raise UserError(f"Gemini needs a key in the environment variable {settings.key_variable}.")
    try:
        from google import genai
    except ImportError:
        raise missing_extra("Gemini", "gemini") from None
    return genai.Client(api_key=key, http_options={"timeout": int(settings.timeout * 1000)})


def _part(part: Any) -> Mapping[str, Any]:
    if isinstance(part, str):
        return {"text": part}
    return (part if isinstance(part, Shown) else Shown(part)).part


def _read_reply(path: Path) -> Reply | None:
    """An answer that was kept; None where there is none, or its file is damaged."""
    if not path.exists() and not path.is_symlink():
        return None
    try:
        kept = unsealed(read_json(path, "an answer that was kept"), str(path))
        counts: list[Any] = [kept.get("input_tokens"), kept.get("output_tokens")]
        if not isinstance(kept.get("text"), str) or not all(type(n) is int and 0 <= n < 2**40 for n in counts):
            raise UserError(f"{path} lacks a text and two numbers of tokens")
        return Reply(kept["text"], *counts)
    except UserError as error:
        log.warning("%s The question is asked again.", error)
        return None


def _is_passing(error: Exception) -> bool:
    if _code(error):
        return _code(error) in _PASSING
    # httpx's errors derive from no built-in one; their names tell.
    return isinstance(error, OSError) or any(word in type(error).__name__ for word in ("Timeout", "Connect", "Network"))


def _code(error: Exception) -> int:
    code = getattr(error, "code", 0)
    return code if isinstance(code, int) else 0


def _count(used: Any, name: str) -> int:
    return int(getattr(used, name, None) or 0)


def _refusal(response: Any) -> str:
    """Why the model refused to answer, empty if it did not."""
    blocked = getattr(getattr(response, "prompt_feedback", None), "block_reason", None)
    if blocked:
        return f"the question was blocked: {_name(blocked)}"
    candidates = getattr(response, "candidates", None) or []
    reason = _name(getattr(candidates[0], "finish_reason", None)) if candidates else ""
    return f"the answer was stopped: {reason}" if reason not in ("", "STOP", "MAX_TOKENS") else ""


def _name(value: Any) -> str:
    return "" if value is None else str(getattr(value, "name", value))
