"""Questions to Gemini through google-genai."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mme_vla.errors import UserError, missing_extra
from mme_vla.subgoal.clips import ENCODING
from mme_vla.subgoal.models.connection import Connection, MediaPart, Message, RawReply, Settings, count
from mme_vla.utils.media import png_bytes, video_bytes


class GoogleConnection(Connection):
    """Google's API.

    client: an object with `models.generate_content(model=, contents=, config=)`, as google-genai's.
    """

    def __init__(self, settings: Settings, client: Any = None) -> None:
        self._settings, self._client = settings, client or _make_client(settings)

    def ask(self, system: str, messages: Sequence[Message]) -> RawReply:
        """See `Connection`."""
        response = self._client.models.generate_content(
            model=self._settings.model,
            contents=[{"role": role, "parts": [_part(part) for part in parts]} for role, parts in messages],
            config={"system_instruction": system, "temperature": self._settings.temperature},
        )
        used = getattr(response, "usage_metadata", None)
        n_output = count(used, "candidates_token_count") + count(used, "thoughts_token_count")
        text = getattr(response, "text", None) or ""
        return RawReply(text, count(used, "prompt_token_count"), n_output, _refusal(response))


def _make_client(settings: Settings) -> Any:
    if not settings.key:
        raise UserError(f"Gemini needs a key in the environment variable {settings.key_variable}.")
    try:
        from google import genai
    except ImportError:
        raise missing_extra("Gemini", "gemini") from None
    return genai.Client(api_key=settings.key, http_options={"timeout": int(settings.timeout * 1000)})


def _part(part: Any) -> Mapping[str, Any]:
    if isinstance(part, str):
        return {"text": part}
    return (part if isinstance(part, MediaPart) else MediaPart(part)).once("google", _inline)


def _inline(pixels: np.ndarray) -> Mapping[str, Any]:
    is_image = pixels.ndim == 3
    data = png_bytes(pixels) if is_image else video_bytes(pixels, **ENCODING)
    return {"inline_data": {"mime_type": "image/png" if is_image else "video/mp4", "data": data}}


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
