"""Qwen3-VL through transformers: questions with images and videos in, completions out,
in batches.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mme_vla.config.devices import find_device
from mme_vla.errors import UserError, brief, did_you_mean, missing_extra, require
from mme_vla.policy.tensor_files import check_transformers_folder
from mme_vla.subgoal.clips import VIDEO_FRAMES, Clip
from mme_vla.subgoal.models.replies import Reply
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
    images: [H, W, 3] uint8 each.
    videos: sampled frames of each.
    target: the answer to learn in training; None for a question to the model.
    """

    system: str
    user: str
    images: list[np.ndarray] = field(default_factory=list)
    videos: list[Clip] = field(default_factory=list)
    target: str | None = None

    def messages(self) -> list[dict[str, Any]]:
        """Return the conversation in the form of chat templates."""
        parts = []
        for piece in split_media(self.user):
            if piece == IMAGE:
                parts.append({"type": "image"})
            elif piece == VIDEO:
                parts.append({"type": "video"})
            else:
                parts.append({"type": "text", "text": piece})
        messages = [
            {"role": "system", "content": [{"type": "text", "text": self.system}]},
            {"role": "user", "content": parts},
        ]
        if self.target is not None:
            reply = [{"type": "text", "text": self.target}]
            messages.append({"role": "assistant", "content": reply})
        return messages


class VLM:
    """A Qwen3-VL model and its processor.

    model, processor: of transformers.
    batch_size: questions answered at once.
    """

    def __init__(self, model: Any, processor: Any, batch_size: int = 8) -> None:
        self.model = model
        self.processor = processor
        self.batch_size = batch_size
        # The released limits of images and videos; they resize nothing of 256×256 pixels.
        area = TOKEN_SIDE**2
        least = 4 * area
        most = VIDEO_FRAMES * VIDEO_TOKENS * area
        image_size = {"shortest_edge": least, "longest_edge": IMAGE_TOKENS * area}
        processor.image_processor.size = image_size
        processor.video_processor.size = {"shortest_edge": least, "longest_edge": most}

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
        require(
            isinstance(batch_size, int) and batch_size >= 1,
            f"batch_size={batch_size!r} must be a whole number, 1 or more.",
        )
        where = find_device(device)  # before the minutes that loading may take
        model, processor = load_model(name, dtype)
        if adapter is not None:
            from peft import PeftModel

            check_transformers_folder(adapter)
            try:
                with warnings.catch_warnings():
                    # Layers that the adapter lacks would stay as they are.
                    warnings.filterwarnings("error", "Found missing adapter keys")
                    model = PeftModel.from_pretrained(model, adapter).merge_and_unload()
            except (OSError, ValueError, RuntimeError, UserWarning) as error:
                raise UserError(
                    f"subgoal.adapter={adapter!r} is no LoRA adapter of {name!r}:"
                    f" {brief(str(error), 500, quote=False)}"
                ) from None
        return cls(model.to(where).eval(), processor, batch_size)

    def encode(self, questions: Sequence[Question], side: str = "left") -> Any:
        """Token ids, masks and pixels of a batch, padded on `side`."""
        texts: list[str] = []
        images: list[np.ndarray] = []
        videos: list[np.ndarray] = []
        metadata: list[dict[str, Any]] = []
        for question in questions:
            text = self.processor.apply_chat_template(
                question.messages(), tokenize=False, add_generation_prompt=question.target is None
            )
            texts.append(text)
            images += question.images
            for clip in question.videos:
                videos.append(clip.frames)
                metadata.append(
                    {
                        "total_num_frames": clip.length,
                        "fps": FPS,
                        "frames_indices": clip.indices.tolist(),
                        "duration": clip.length / FPS,
                    }
                )
        options: dict[str, Any] = {}
        if images:
            options["images"] = images
        if videos:
            options |= {"videos": videos, "video_metadata": metadata, "do_sample_frames": False}
        return self.processor(
            text=texts, padding=True, padding_side=side, return_tensors="pt", **options
        )

    @torch.inference_mode()
    def generate(self, questions: Sequence[Question], max_new_tokens: int = 128) -> list[Reply]:
        """Answer greedily; special tokens of points stay. The other questions of a batch change an
        answer by rounding only.
        """
        tokenizer = self.processor.tokenizer
        ends = {tokenizer.eos_token_id, tokenizer.pad_token_id}
        completions: list[Reply] = []
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
            answers = sequences[:, batch["input_ids"].shape[1] :].tolist()
            lengths = batch["attention_mask"].sum(1).tolist()
            for ids, length in zip(answers, lengths, strict=True):
                tokens = [token for token in ids if token not in ends]
                # The marks of points are special tokens and must stay.
                text = tokenizer.decode(tokens, skip_special_tokens=False).strip()
                completions.append(Reply(text, length, len(tokens)))
        return completions


def load_model(name: str, dtype: str = "bfloat16") -> tuple[Any, Any]:
    """Load a model and its processor, on the CPU."""
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
        model = Qwen3VLForConditionalGeneration.from_pretrained(name, dtype=getattr(torch, dtype))
    except (OSError, ValueError) as error:
        source = "that folder" if Path(name).exists() else "the hub"
        first_line = str(error).splitlines()[0]
        raise UserError(f"No Qwen3-VL model {name!r} in {source}: {first_line}") from None
    return model, processor
