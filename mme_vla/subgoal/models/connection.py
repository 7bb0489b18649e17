"""What a model behind an API is asked through: its settings, what a conversation is made of, what comes back."""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from mme_vla.errors import UserError

Message = tuple[str, list[Any]]
"""Role (`user` or `model`); parts: texts, images [H, W, 3], videos [t, H, W, 3], bare or as `Shown`."""


@dataclass(frozen=True)
class Settings:
    """How an API is used; the defaults are those of Gemini.

    model: its name. key_variable: environment variable that holds the key; None where none is needed.
    temperature: 0 for the likeliest answer; None for models that take none.
    timeout: seconds before an answer is given up.
    retries: further tries after a passing error. backoff: seconds before the first of them, doubled each time.
    requests_per_minute: rate limit; None for none. cache: folder of answers; None keeps none.
    input_price, output_price: US dollars for a million tokens.
    """

    model: str = "gemini-2.5-pro"
    key_variable: str | None = "GEMINI_API_KEY"
    temperature: float | None = 0.0
    timeout: float = 120.0
    retries: int = 5
    backoff: float = 2.0
    requests_per_minute: float | None = 60
    cache: str | None = None
    input_price: float = 1.25
    output_price: float = 10.0

    def __post_init__(self) -> None:
        for name, expected in _WANTED.items():
            value = getattr(self, name)
            if value is None and "null" in expected:
                continue
            usable = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
            if not usable or value < 0 or (value == 0 and "above" in expected):
                raise UserError(f"{name}={value!r} must be {expected}.")
        if not isinstance(self.retries, int):
            raise UserError(f"retries={self.retries!r} must be a whole number, 0 or more.")

    @property
    def key(self) -> str:
        """The key, empty where there is none."""
        return "" if self.key_variable is None else os.environ.get(self.key_variable, "")

    @property
    def secrets(self) -> list[str]:
        """What no log, record or cache may hold."""
        return [self.key] if self.key else []


_WANTED = {
    "temperature": "a number, 0 or more, or null for models that take none",
    "timeout": "a number of seconds above 0",
    "retries": "a whole number, 0 or more",
    "backoff": "a number of seconds, 0 or more",
    "requests_per_minute": "a number above 0, or null for no limit",
    "input_price": "a number of dollars, 0 or more",
    "output_price": "a number of dollars, 0 or more",
}


@dataclass
class MediaPart:
    """An image [H, W, 3] or video [t, H, W, 3] of a conversation, encoded once however many questions show it."""

    pixels: np.ndarray
    _encoded: dict[str, Any] = field(default_factory=dict)

    def once[T](self, form: str, encode: Callable[[np.ndarray], T]) -> T:
        """What is sent in this form."""
        if form not in self._encoded:
            self._encoded[form] = encode(self.pixels)
        encoded: T = self._encoded[form]
        return encoded


@dataclass(frozen=True)
class RawReply:
    """What an API answered. refusal: why the model would not answer, empty if it did. Thoughts count as output."""

    text: str
    input_tokens: int
    output_tokens: int
    refusal: str = ""


class Connection:
    """One way to speak to models. A subclass says how it is set, and asks.

    Args:
        settings: of its own kind.
        client: what the questions go to; None makes one.
    """

    settings_type: ClassVar[type[Settings]] = Settings

    def __init__(self, settings: Any, client: Any = None) -> None:
        raise NotImplementedError

    def ask(self, system: str, messages: Sequence[Message]) -> RawReply:
        """Ask the last turn of a conversation, once; whatever goes wrong is raised as the client raises it."""
        raise NotImplementedError

    @staticmethod
    def cached_as(settings: Any) -> list[Any]:
        """What, beside the conversation, decides an answer: part of the name it is cached under."""
        return [settings.model, settings.temperature]


def count(used: Any, name: str) -> int:
    """A number of tokens, 0 where an API does not say."""
    return int(getattr(used, name, None) or 0)
