"""Questions to a model behind an API: retries, rate limit, time limit, cache of replies, cost. No
secret is logged.
"""

import hashlib
import json
import logging
import threading
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Any, cast

import numpy as np

from mme_vla.config.sections import read_section
from mme_vla.errors import UserError, did_you_mean, require
from mme_vla.subgoal.base import Usage
from mme_vla.subgoal.models.connection import (
    Connection,
    GoogleConnection,
    MediaPart,
    Message,
    OpenAIConnection,
    Settings,
)  # fmt: skip
from mme_vla.utils import read_json, verified, with_checksum


def start[T](call: Callable[[], T]) -> Future[T]:
    """Begin a call in a daemon thread, which does not keep an interrupted process alive."""
    future: Future[T] = Future()

    def work() -> None:
        try:
            future.set_result(call())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=work, name="subgoals", daemon=True).start()
    return future


def side_by_side[A, T](call: Callable[[A], T], items: Sequence[A], workers: int) -> list[T]:
    """Call with each item, `workers` at a time; the results in the items' order.

    Raises:
        Exception: of the first item that failed; no further call begins then.
    """
    failed = threading.Event()

    def guarded(item: A) -> T | None:
        if failed.is_set():
            return None  # the error of an earlier item is raised
        try:
            return call(item)
        except BaseException:
            failed.set()
            raise

    if not items:
        return []
    with ThreadPool(min(workers, len(items))) as pool:  # daemon threads
        return cast(list[T], list(pool.imap(guarded, items)))


log = logging.getLogger(__name__)
CONNECTIONS: dict[str, type[Connection]] = {"gemini": GoogleConnection, "openai": OpenAIConnection}
"""Clients by the name of their API."""

_PASSING = (408, 429, 500, 502, 503, 504)  # HTTP: worth another try
_FATAL = (401, 403, 404)  # the key or the model's name is wrong: no question will ever be answered
_LONGEST_PAUSE = 60.0  # seconds
# characters; what is shorter protects nothing, such as the key `none`, and may be a word of an
# answer
_SECRET = 8


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
    """Asks one model. Safe to use from several threads.

    client: what the connection asks, such as google-genai's; None makes one: at once, but with a
    cache and no key when
        the first question comes that the cache does not hold.
    clock, sleep: of the rate limit and the pauses.
    provider: a key of `CONNECTIONS`.
    """

    settings: Settings
    usage: Usage
    client: Any = None
    clock: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep
    provider: str = "gemini"
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _next: float = 0.0

    def __post_init__(self) -> None:
        self._connection: Connection | None = None
        if self.client is not None or self.settings.cache is None or self.settings.key:
            self._connected()

    def _connected(self) -> Connection:
        with self._lock:
            if self._connection is None:
                self._connection = CONNECTIONS[self.provider](self.settings, self.client)
            return self._connection

    def ask(self, system: str, messages: Sequence[Message]) -> Reply:
        """Ask the last turn of a conversation.

        Raises:
            ApiFailure: no usable answer came, after all tries.
            UserError: the key or the model's name is not accepted.
        """
        known = self._cache_file(system, messages)
        if known is not None and (cached := _read_reply(known)) is not None:
            with self._lock:
                self.usage.cached += 1
            return cached
        reply = self._tried(system, messages)
        if known is not None:
            known.parent.mkdir(parents=True, exist_ok=True)
            draft = known.with_suffix(
                f".{uuid.uuid4().hex}.partial"
            )  # other processes may share the folder
            draft.write_text(json.dumps(with_checksum(vars(reply))))
            try:
                draft.replace(known)
            except (
                OSError
            ) as error:  # a folder in its place: the answer counts, it is only not kept
                draft.unlink(missing_ok=True)
                log.warning("%s cannot be written: %s", known, error.strerror)
        return reply

    def _tried(self, system: str, messages: Sequence[Message]) -> Reply:
        try:
            connection = self._connected()
        except UserError as error:
            hint = (
                ""
                if self.settings.cache is None
                else f" (The cache {self.settings.cache} lacks this answer.)"
            )
            raise UserError(f"{error}{hint}") from None
        pause = self.settings.backoff
        failure = ApiFailure("failed", "never asked")
        for attempt in range(self.settings.retries + 1):
            if attempt:
                with self._lock:
                    self.usage.retries += 1
                self.sleep(min(pause, _LONGEST_PAUSE))
                pause *= 2
            self._wait_for_slot()
            try:
                return self._once(connection, system, messages)
            except ApiFailure as error:
                failure = error
                if error.problem == "refused":
                    break
            except Exception as error:  # whatever the network and the client come up with
                reason = self._redacted(f"{type(error).__name__}: {error}")
                if _code(error) in _FATAL or (
                    _code(error) == 400 and "api key" in str(error).lower()
                ):
                    raise UserError(
                        f"{self.settings.model} cannot be asked: {reason}. Check the key in "
                        f"${self.settings.key_variable} and the model's name."
                    ) from None
                failure = ApiFailure("failed", reason)
                if not _is_passing(error):
                    break
            log.info("%s: try %d came to nothing (%s)", self.settings.model, attempt + 1, failure)
        raise failure

    def _once(self, connection: Connection, system: str, messages: Sequence[Message]) -> Reply:
        started = self.clock()
        raw = start(lambda: connection.ask(system, messages)).result(self.settings.timeout)
        prices = self.settings.input_price, self.settings.output_price
        with self._lock:
            self.usage.calls += 1
            self.usage.seconds += self.clock() - started
            self.usage.input_tokens += raw.input_tokens
            self.usage.output_tokens += raw.output_tokens
            self.usage.cost += (raw.input_tokens * prices[0] + raw.output_tokens * prices[1]) / 1e6
        if raw.refusal:
            raise ApiFailure("refused", self._redacted(raw.refusal, _SECRET))
        if not (text := self._redacted(raw.text, _SECRET).strip()):
            raise ApiFailure("empty", "the answer is empty")
        return Reply(text, raw.input_tokens, raw.output_tokens)

    def _wait_for_slot(self) -> None:
        if self.settings.requests_per_minute is None:
            return
        with self._lock:
            start = max(self.clock(), self._next)
            self._next = start + 60 / self.settings.requests_per_minute
        if (wait := start - self.clock()) > 0:
            self.sleep(wait)

    def _cache_file(self, system: str, messages: Sequence[Message]) -> Path | None:
        if self.settings.cache is None:
            return None
        digest = hashlib.sha256(
            json.dumps([*CONNECTIONS[self.provider].cached_as(self.settings), system]).encode()
        )
        for role, parts in messages:
            digest.update(f"\n{role}".encode())
            for item in parts:
                part = item.pixels if isinstance(item, MediaPart) else item
                # The images themselves, not their encoding, which may differ between versions of
                # the encoder.
                raw = (
                    part.encode() if isinstance(part, str) else np.ascontiguousarray(part).tobytes()
                )
                digest.update(f"\n{getattr(part, 'shape', 'text')} {len(raw)} ".encode() + raw)
        name = digest.hexdigest()
        return Path(self.settings.cache) / name[:2] / f"{name}.json"

    def _redacted(self, text: str, shortest: int = 1) -> str:
        """Text without the secrets, as far as they have `shortest` characters."""
        for secret in sorted(self.settings.secrets, key=len, reverse=True):
            if len(secret) >= shortest:
                text = text.replace(secret, "***")
        return text


def _read_reply(path: Path) -> Reply | None:
    """An answer that was kept; None where there is none, or its file is damaged."""
    if not path.exists() and not path.is_symlink():
        return None
    try:
        stored = verified(read_json(path, "an answer that was kept"), str(path))
        counts: list[Any] = [stored.get("input_tokens"), stored.get("output_tokens")]
        if not isinstance(stored.get("text"), str) or not all(
            type(n) is int and 0 <= n < 2**40 for n in counts
        ):
            raise UserError(f"{path} lacks a text and two numbers of tokens")
        return Reply(stored["text"], *counts)
    except UserError as error:
        log.warning("%s The question is asked again.", error)
        return None


def _is_passing(error: Exception) -> bool:
    if _code(error):
        return _code(error) in _PASSING
    # httpx's errors derive from no built-in one; their names tell.
    return isinstance(error, OSError) or any(
        word in type(error).__name__ for word in ("Timeout", "Connect", "Network")
    )


def _code(error: Exception) -> int:
    codes = (
        getattr(error, name, 0) for name in ("status_code", "code")
    )  # as openai has it, as google-genai has it
    return next((code for code in codes if isinstance(code, int) and code), 0)


def make_api(
    provider: str, settings: Mapping[str, Any], where: str, usage: Usage, client: Any = None
) -> Api:
    """An `Api` out of plain settings.

    Args:
        provider: a key of `CONNECTIONS`. settings: of its kind. where: the section they stand in,
            for messages.
    """
    require(
        provider in CONNECTIONS,
        f"{where}.api={provider!r}. {did_you_mean(str(provider), CONNECTIONS)}",
    )
    return Api(
        read_section(CONNECTIONS[provider].settings_type, settings, where),
        usage,
        client,
        provider=provider,
    )
