"""Qwen3-VL through transformers: questions with images and videos in, completions out,
in batches.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mme_vla.config.devices import find_device
from mme_vla.errors import UserError, did_you_mean, missing_extra, require
from mme_vla.policy.tensor_files import check_transformers_folder
from mme_vla.subgoal.clips import VIDEO_FRAMES, Clip
from mme_vla.subgoal.models.tiny import make_tiny
from mme_vla.subgoal.text import IMAGE, VIDEO, split_media
from mme_vla.utils.media import FPS

IMAGE_TOKENS, VIDEO_TOKENS = 256, 64  # at most: an image; a video frame
TOKEN_SIDE = 32  # pixels of a token: patches of 16, merged 2×2
TINY = "tiny"
DTYPES = ("float32", "bfloat16", "float16")


@dataclass(frozen=True)
class Question:
    """One question.

    system, user: texts; `<image>` and `<video>` in the user's mark where images go.
    images: [H, W, 3] uint8 each. videos: what is looked at of each.
    target: what the model is to learn to say; None where it is asked.
    """

    system: str
    user: str
    images: list[np.ndarray] = field(default_factory=list)
    videos: list[Clip] = field(default_factory=list)
    target: str | None = None

    def messages(self) -> list[dict[str, Any]]:
        """The conversation in the form of chat templates."""
        kinds = {IMAGE: {"type": "image"}, VIDEO: {"type": "video"}}
        parts = [
            kinds.get(piece, {"type": "text", "text": piece}) for piece in split_media(self.user)
        ]
        messages = [{"role": "system", "content": [{"type": "text", "text": self.system}]}]
        messages.append({"role": "user", "content": parts})
        if self.target is not None:
            messages.append(
                {"role": "assistant", "content": [{"type": "text", "text": self.target}]}
            )
        return messages


@dataclass(frozen=True)
class Completion:
    """What the model said, special tokens of points kept; and the tokens it read and wrote."""

    text: str
    input_tokens: int
    output_tokens: int


class VLM:
    """A Qwen3-VL model and its processor.

    model, processor: of transformers. batch_size: questions answered at once.
    """

    def __init__(self, model: Any, processor: Any, batch_size: int = 8) -> None:
        _check_batch(batch_size)
        self.model, self.processor, self.batch_size = model, processor, batch_size
        limit_images(processor)

    @classmethod
    def load(
        cls,
        name: str,
        adapter: str | None = None,
        *,
        device: str = "auto",
        dtype: str = "bfloat16",
        batch_size: int = 8,
    ) -> "VLM":
        """Load a model.

        Args:
            name: a repository on the hub, a folder, or `tiny`.
            adapter: folder or repository of a LoRA adapter (PEFT); ms-swift's checkpoints are such.
            device: `auto` (a GPU where there is one), `cpu`, `cuda`, `cuda:1`, …
            dtype: of the weights, one of `DTYPES`.
        """
        _check_batch(batch_size)
        place = find_device(device)  # before the minutes that loading may take
        model, processor = load_model(name, dtype)
        if adapter is not None:
            from peft import PeftModel

            check_transformers_folder(adapter)
            try:
                model = PeftModel.from_pretrained(model, adapter).merge_and_unload()
            except (OSError, ValueError) as error:
                raise UserError(
                    f"subgoal.adapter={adapter!r} is no LoRA adapter of {name!r}: {error}"
                ) from None
        return cls(model.to(place).eval(), processor, batch_size)

    def encode(self, questions: Sequence[Question], side: str = "left") -> Any:
        """Token ids, masks and pixels of a batch, padded on `side`."""
        texts = [
            self.processor.apply_chat_template(
                q.messages(), tokenize=False, add_generation_prompt=q.target is None
            )
            for q in questions
        ]
        images = [image for q in questions for image in q.images]
        videos = [video for q in questions for video in q.videos]
        options: dict[str, Any] = {"images": images} if images else {}
        if videos:
            options["videos"] = [video.frames for video in videos]
            options["video_metadata"] = [
                {
                    "total_num_frames": video.length,
                    "fps": FPS,
                    "frames_indices": video.indices.tolist(),
                    "duration": video.length / FPS,
                }
                for video in videos
            ]
            options["do_sample_frames"] = False
        return self.processor(
            text=texts, padding=True, padding_side=side, return_tensors="pt", **options
        )

    @torch.inference_mode()
    def generate(
        self, questions: Sequence[Question], max_new_tokens: int = 128
    ) -> list[Completion]:
        """Answer greedily. What is asked together does not change an answer beyond rounding."""
        completions: list[Completion] = []
        for start in range(0, len(questions), self.batch_size):
            batch = self.encode(questions[start : start + self.batch_size]).to(self.model.device)
            sequences = self.model.generate(
                **batch,
                max_new_tokens=max_new_tokens,
                do_sample=False,
                temperature=None,
                top_p=None,
                top_k=None,
            )
            read = batch["attention_mask"].sum(1).tolist()
            completions += [
                self._reply(ids, n)
                for ids, n in zip(sequences[:, batch["input_ids"].shape[1] :], read, strict=True)
            ]
        return completions

    def _reply(self, ids: torch.Tensor, read: int) -> Completion:
        tokenizer = self.processor.tokenizer
        ends = {tokenizer.eos_token_id, tokenizer.pad_token_id}
        tokens = [token for token in ids.tolist() if token not in ends]
        # The marks of points are special tokens and must stay.
        return Completion(
            tokenizer.decode(tokens, skip_special_tokens=False).strip(), read, len(tokens)
        )


def load_model(name: str, dtype: str = "bfloat16") -> tuple[Any, Any]:
    """A model and its processor, on the CPU."""
    require(dtype in DTYPES, f"dtype={dtype!r} of a Qwen3-VL. {did_you_mean(str(dtype), DTYPES)}")
    try:
        from transformers import AutoProcessor, Qwen3VLForConditionalGeneration
    except ImportError:
        raise missing_extra("Qwen3-VL", "vlm") from None
    if name == TINY:
        return make_tiny()
    check_transformers_folder(name)
    try:
        processor = AutoProcessor.from_pretrained(name)
        return Qwen3VLForConditionalGeneration.from_pretrained(
            name, dtype=getattr(torch, dtype)
        ), processor
    except (OSError, ValueError) as error:
        place = "that folder" if Path(name).exists() else "the hub"
        raise UserError(
            f"No Qwen3-VL model {name!r} in {place}: {str(error).splitlines()[0]}"
        ) from None


def _check_batch(size: int) -> None:
    require(
        isinstance(size, int) and size >= 1,
        f"batch_size={size!r} must be a whole number, 1 or more.",
    )


def limit_images(processor: Any) -> None:
    """Hold images and videos to the released limits; nothing of 256×256 pixels is
    resized by them.
    """
    area = TOKEN_SIDE**2
    processor.image_processor.size = {
        "shortest_edge": 4 * area,
        "longest_edge": IMAGE_TOKENS * area,
    }
    processor.video_processor.size = {
        "shortest_edge": 4 * area,
        "longest_edge": VIDEO_FRAMES * VIDEO_TOKENS * area,
    }
