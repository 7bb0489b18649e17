"""Questions to any endpoint that speaks OpenAI's chat completions: OpenAI's own, vLLM, Ollama, and many others."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np

from mme_vla.errors import UserError, missing_extra
from mme_vla.subgoal.clips import sample_video
from mme_vla.subgoal.models.connection import Connection, MediaPart, Message, RawReply, Settings, count
from mme_vla.utils.media import png_bytes

_ROLES = {"user": "user", "model": "assistant"}


@dataclass(frozen=True)
class OpenAISettings(Settings):
    """As `Settings`, for OpenAI's chat completions.

    base_url: of the endpoint, such as http://127.0.0.1:8000/v1; None for OpenAI's own.
    video_frames: images that stand for a video, which these endpoints take none of; even, 2 or more.
    """

    model: str = "gpt-5-mini"
    key_variable: str | None = "OPENAI_API_KEY"
    temperature: float | None = None
    input_price: float = 0.0
    output_price: float = 0.0
    base_url: str | None = None
    video_frames: int = 10

    def __post_init__(self) -> None:
        super().__post_init__()
        frames = self.video_frames
        if isinstance(frames, bool) or not isinstance(frames, int) or frames < 2 or frames % 2:
            raise UserError(f"video_frames={frames!r} must be an even number of images, 2 or more.")
        if self.base_url is not None and _scheme(self.base_url) not in ("http", "https"):
            shown = str(self.base_url).rpartition("@")[2]  # without a password
            raise UserError(f"base_url={shown!r} must be an address such as http://127.0.0.1:8000/v1, or null.")

    @property
    def login(self) -> str:
        """`user:password` of an address that has them, else empty."""
        address = urlsplit(self.base_url or "")
        if not (address.username or address.password):
            return ""
        return f"{unquote(address.username or '')}:{unquote(address.password or '')}"

    @property
    def secrets(self) -> list[str]:
        """See `Settings`; the password of an address is one too, and its base64, as which it is sent."""
        login = self.login
        return [*super().secrets, *filter(None, (login, _base64(login), login.partition(":")[2]))]


class OpenAIConnection(Connection):
    """OpenAI's chat completions; a video is sent as images out of it.

    client: an object with `chat.completions.create(model=, messages=, …)`, as openai's.
    """

    settings_type = OpenAISettings

    def __init__(self, settings: OpenAISettings, client: Any = None) -> None:
        self._settings, self._client = settings, client or _make_client(settings)

    def ask(self, system: str, conversation: Sequence[Message]) -> RawReply:
        """See `Connection`."""
        messages: list[dict[str, Any]] = [{"role": "system", "content": system}]
        messages += [{"role": _ROLES[role], "content": self._content(role, parts)} for role, parts in conversation]
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
        """See `Connection`; where the endpoint is does not count, as another machine may have it elsewhere."""
        return [settings.model, settings.temperature, "openai", settings.video_frames]


def _make_client(settings: OpenAISettings) -> Any:
    if settings.key_variable is not None and not settings.key:
        raise UserError(
            f"{settings.model} needs a key in the environment variable {settings.key_variable}; an endpoint that asks "
            "for none has key_variable=null."
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
        default_headers={"Authorization": f"Basic {_base64(settings.login)}"} if settings.login else None,
        timeout=settings.timeout,
        max_retries=0,
    )


def _scheme(address: object) -> str:
    try:
        return urlsplit(str(address)).scheme
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
