"""Clients of models behind an API: google-genai, and OpenAI's chat completions, which vLLM and
Ollama serve too.
"""

import base64
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, ClassVar
from urllib.parse import unquote, urlsplit

import numpy as np

from mme_vla.config.sections import NonNegative, NonNegativeInt, Positive, Range
from mme_vla.errors import UserError, missing_extra, require
from mme_vla.subgoal.clips import ENCODING, sample_video
from mme_vla.utils.media import png_bytes, video_bytes

Message = tuple[str, list[Any]]
"""Role (`user` or `model`); parts: texts, images [H, W, 3], videos [t, H, W, 3], bare or as
`MediaPart`.
"""


@dataclass(frozen=True)
class Settings:
    """How an API is used; the defaults are those of Gemini.

    model: its name. key_variable: environment variable that holds the key; None where none is
    needed. temperature: 0 for the likeliest answer; None for models that take none.
    timeout: seconds before an answer is given up.
    retries: further tries after a passing error. backoff: seconds before the first of them, doubled
    each time. requests_per_minute: rate limit; None for none. cache: folder of replies; None keeps
    none. input_price, output_price: US dollars for a million tokens.
    """

    model: str = "gemini-2.5-pro"
    key_variable: str | None = "GEMINI_API_KEY"
    temperature: NonNegative | None = 0.0
    timeout: Positive = 120.0
    retries: NonNegativeInt = 5
    backoff: NonNegative = 2.0
    requests_per_minute: Positive | None = 60
    cache: str | None = None
    input_price: NonNegative = 1.25
    output_price: NonNegative = 10.0

    @property
    def key(self) -> str:
        return "" if self.key_variable is None else os.environ.get(self.key_variable, "")

    @property
    def secrets(self) -> list[str]:
        """What no log, record or cache may hold."""
        return [self.key] if self.key else []


@dataclass
class MediaPart:
    """An image [H, W, 3] or video [t, H, W, 3] of a conversation, encoded once however many
    questions show it.
    """

    pixels: np.ndarray
    _encoded: dict[str, Any] = field(default_factory=dict)

    def once[T](self, form: str, encode: Callable[[np.ndarray], T]) -> T:
        if form not in self._encoded:
            self._encoded[form] = encode(self.pixels)
        encoded: T = self._encoded[form]
        return encoded


@dataclass(frozen=True)
class RawReply:
    """What an API answered. refusal: why the model would not answer, empty if it did. Thoughts
    count as output.
    """

    text: str
    input_tokens: int
    output_tokens: int
    refusal: str = ""


class Connection:
    """A client of an API. A subclass has a type of settings, and `ask`.

    Args:
        settings: of its own kind.
        client: what the questions go to; None makes one.
    """

    settings_type: ClassVar[type[Settings]] = Settings

    def __init__(self, settings: Any, client: Any = None) -> None:
        raise NotImplementedError

    def ask(self, system: str, messages: Sequence[Message]) -> RawReply:
        """Ask the last turn of a conversation, once; whatever goes wrong is raised as the client
        raises it.
        """
        raise NotImplementedError

    @staticmethod
    def cached_as(settings: Any) -> list[Any]:
        """What, beside the conversation, decides an answer: part of the name it is cached under."""
        return [settings.model, settings.temperature]


def count(used: Any, name: str) -> int:
    """A number of tokens, 0 where an API does not say."""
    return int(getattr(used, name, None) or 0)


class GoogleConnection(Connection):
    """Google's API.

    client: an object with `models.generate_content(model=, contents=, config=)`, as google-genai's.
    """

    def __init__(self, settings: Settings, client: Any = None) -> None:
        self._settings, self._client = settings, client or _google_client(settings)

    def ask(self, system: str, messages: Sequence[Message]) -> RawReply:
        response = self._client.models.generate_content(
            model=self._settings.model,
            contents=[
                {"role": role, "parts": [_part(part) for part in parts]} for role, parts in messages
            ],
            config={"system_instruction": system, "temperature": self._settings.temperature},
        )
        used = getattr(response, "usage_metadata", None)
        n_output = count(used, "candidates_token_count") + count(used, "thoughts_token_count")
        text = getattr(response, "text", None) or ""
        return RawReply(text, count(used, "prompt_token_count"), n_output, _refusal(response))


def _google_client(settings: Settings) -> Any:
    require(
        settings.key, f"Gemini needs a key in the environment variable {settings.key_variable}."
    )
    try:
        from google import genai
    except ImportError:
        raise missing_extra("Gemini", "gemini") from None
    return genai.Client(
        api_key=settings.key, http_options={"timeout": int(settings.timeout * 1000)}
    )


def _part(part: Any) -> Mapping[str, Any]:
    if isinstance(part, str):
        return {"text": part}

    def inline(pixels: np.ndarray) -> Mapping[str, Any]:
        is_image = pixels.ndim == 3
        data = png_bytes(pixels) if is_image else video_bytes(pixels, **ENCODING)
        return {
            "inline_data": {"mime_type": "image/png" if is_image else "video/mp4", "data": data}
        }

    return (part if isinstance(part, MediaPart) else MediaPart(part)).once("google", inline)


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


@dataclass(frozen=True)
class OpenAISettings(Settings):
    """As `Settings`, for OpenAI's chat completions.

    base_url: of the endpoint, such as http://127.0.0.1:8000/v1; None for OpenAI's own.
    video_frames: images sent in place of a video, which these endpoints do not take; even, 2 or
    more.
    """

    model: str = "gpt-5-mini"
    key_variable: str | None = "OPENAI_API_KEY"
    temperature: NonNegative | None = None
    input_price: NonNegative = 0.0
    output_price: NonNegative = 0.0
    base_url: str | None = None
    video_frames: Annotated[int, Range(least=2)] = 10

    def __post_init__(self) -> None:
        require(
            not (self.video_frames % 2),
            f"video_frames={self.video_frames} must be an even number of images, 2 or more.",
        )
        if self.base_url is not None and _scheme(self.base_url) not in ("http", "https"):
            visible = self.base_url.rpartition("@")[2]  # without a password
            raise UserError(
                f"base_url={visible!r} must be an address such as http://127.0.0.1:8000/v1, or"
                " null."
            )

    @property
    def login(self) -> str:
        """`user:password` of an address that has them, else empty."""
        address = urlsplit(self.base_url or "")
        if not (address.username or address.password):
            return ""
        return f"{unquote(address.username or '')}:{unquote(address.password or '')}"

    @property
    def secrets(self) -> list[str]:
        """See `Settings`; the password of an address is one too, and its base64, as which it is
        sent.
        """
        login = self.login
        return [*super().secrets, *filter(None, (login, _base64(login), login.partition(":")[2]))]


class OpenAIConnection(Connection):
    """OpenAI's chat completions; a video is sent as images out of it.

    client: an object with `chat.completions.create(model=, messages=, …)`, as openai's.
    """

    settings_type = OpenAISettings

    def __init__(self, settings: OpenAISettings, client: Any = None) -> None:
        self._settings, self._client = settings, client or _openai_client(settings)

    def ask(self, system: str, conversation: Sequence[Message]) -> RawReply:
        messages: list[dict[str, Any]] = [{"role": "system", "content": system}]
        messages += [
            {
                "role": "assistant" if role == "model" else role,
                "content": self._content(role, parts),
            }
            for role, parts in conversation
        ]
        temperature = self._settings.temperature
        response = self._client.chat.completions.create(
            model=self._settings.model,
            messages=messages,
            **({} if temperature is None else {"temperature": temperature}),
        )
        used = getattr(response, "usage", None)
        read, n_output = count(used, "prompt_tokens"), count(used, "completion_tokens")
        if not (choices := getattr(response, "choices", None)):
            return RawReply("", read, n_output)
        message = choices[0].message
        refusal = getattr(message, "refusal", None) or ""
        if choices[0].finish_reason == "content_filter":
            refusal = refusal or "the answer was stopped: content_filter"
        return RawReply(getattr(message, "content", None) or "", read, n_output, refusal)

    def _content(self, role: str, parts: Sequence[Any]) -> Any:
        if role == "model":
            return "".join(parts)  # many servers take an assistant's words as a text alone
        return [piece for part in parts for piece in self._pieces(part)]

    def _pieces(self, part: Any) -> list[dict[str, Any]]:
        if isinstance(part, str):
            return [{"type": "text", "text": part}]
        most = self._settings.video_frames
        return (part if isinstance(part, MediaPart) else MediaPart(part)).once(
            f"openai {most}", partial(_image_parts, most=most)
        )

    @staticmethod
    def cached_as(settings: OpenAISettings) -> list[Any]:
        """See `Connection`; where the endpoint is does not count, as another machine may have it
        elsewhere.
        """
        return [settings.model, settings.temperature, "openai", settings.video_frames]


def _openai_client(settings: OpenAISettings) -> Any:
    require(
        settings.key_variable is None or settings.key,
        f"{settings.model} needs a key in the environment variable {settings.key_variable}; an"
        " endpoint that asks for none has key_variable=null.",
    )
    try:
        import openai
    except ImportError:
        raise missing_extra("An OpenAI-compatible endpoint", "openai") from None
    # The client's errors and logs name its address: the login travels in a header instead.
    address = urlsplit(settings.base_url or "")
    address = address._replace(netloc=address.netloc.rpartition("@")[2])
    # Tries are counted, and waited between, by `Api`.
    return openai.OpenAI(
        api_key=settings.key or "none",
        base_url=address.geturl() or None,
        default_headers={"Authorization": f"Basic {_base64(settings.login)}"}
        if settings.login
        else None,
        timeout=settings.timeout,
        max_retries=0,
    )


def _scheme(address: str) -> str:
    try:
        return urlsplit(address).scheme
    except ValueError:  # brackets that hold no address
        return ""


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode("ascii")


def _image_parts(pixels: np.ndarray, most: int) -> list[dict[str, Any]]:
    if pixels.ndim == 3:
        return [_image_part(pixels)]
    places = sample_video(len(pixels), most=most)
    caption = f"A video of {len(pixels)} frames; {len(places)} of them in order:"
    return [{"type": "text", "text": caption}, *(_image_part(pixels[i]) for i in places)]


def _image_part(pixels: np.ndarray) -> dict[str, Any]:
    data = base64.b64encode(png_bytes(pixels)).decode("ascii")
    return {"type": "image_url", "image_url": {"url": f"data:image/png;base64,{data}"}}
