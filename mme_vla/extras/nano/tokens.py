"""Tokens of the frames of demonstrations: the tower reads each frame once, for all memories and
trainings.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from omegaconf import OmegaConf
from torch import Tensor

import mme_vla.memory  # noqa: F401  (registers what ships)
from mme_vla.errors import require
from mme_vla.extras.nano.demonstrations import Demonstration
from mme_vla.memory.history import FrameScores, score_frames
from mme_vla.policy.build import build_from_config
from mme_vla.policy.mme import MMEPolicy, mme_of
from mme_vla.policy.sections import PolicySections
from mme_vla.registry import MEMORIES
from mme_vla.utils import write_atomically

if TYPE_CHECKING:
    from mme_vla.memory.base import Memory

_SOME_WIDTH = 64  # what a scorer gives does not depend on the width of tokens


@dataclass(frozen=True)
class FrameTokens:
    """What the tower made of a demonstration's frames.

    frames: camera → its rendered frames [n] int64, ascending.
    tokens: camera → [n, patches, d] float16.
    scores: key of a frame scorer → the rows it gave for the memory camera.
    """

    frames: dict[str, np.ndarray]
    tokens: dict[str, Tensor]
    scores: dict[str, FrameScores] = field(default_factory=dict)

    def at(self, camera: str, frames: Sequence[int] | np.ndarray) -> Tensor:
        """The tokens [n, patches, d] of these frames."""
        known = self.frames[camera]
        numbers = np.asarray(frames, np.int64)
        missing = sorted(set(numbers.tolist()) - set(known.tolist()))
        require(
            not missing,
            f"The demonstration holds no tokens of frames {missing[:5]}: they were not rendered.",
        )
        return self.tokens[camera][torch.from_numpy(np.searchsorted(known, numbers))]

    def save(self, path: Path, stamp: str) -> None:
        """Write one file, which appears whole or not at all. stamp: of the demonstration
        (see `TokenStore.make`).
        """
        from safetensors.torch import save_file

        tensors: dict[str, Tensor] = {}
        for name, tokens in self.tokens.items():
            tensors[f"tokens/{name}"] = tokens
        for name, frames in self.frames.items():
            tensors[f"frames/{name}"] = torch.from_numpy(frames)
        for key, rows in self.scores.items():
            tensors[f"scored/{key}"] = torch.from_numpy(rows.frames)
            tensors[f"scores/{key}"] = torch.from_numpy(rows.values)
        contiguous = {name: value.contiguous() for name, value in tensors.items()}
        path.parent.mkdir(parents=True, exist_ok=True)
        with write_atomically(path) as draft:
            save_file(contiguous, draft, {"stamp": stamp})

    @classmethod
    def load(cls, path: Path) -> "FrameTokens":
        """Read what `save` wrote."""
        from safetensors.torch import load_file

        parts: dict[str, dict[str, Tensor]] = {
            "tokens": {},
            "frames": {},
            "scored": {},
            "scores": {},
        }
        for name, value in load_file(path).items():
            part, _, key = name.partition("/")
            parts[part][key] = value
        frames = {name: value.numpy() for name, value in parts["frames"].items()}
        scores = {}
        for key, values in parts["scores"].items():
            scores[key] = FrameScores(parts["scored"][key].numpy(), values.numpy())
        return cls(frames, parts["tokens"], scores)


@torch.no_grad()
def tokenize(
    policy: MMEPolicy, demonstration: Demonstration, memories: Iterable["Memory"] = ()
) -> FrameTokens:
    """Encode all rendered frames of a demonstration.

    policy: with the tower.
    memories: those whose scorers rate its frames, beside the policy's own.
    """
    processor = policy.require_processor()
    frames: dict[str, np.ndarray] = {}
    tokens: dict[str, Tensor] = {}
    for camera in policy.embodiment.camera_names:
        taken = demonstration.images[camera]
        frames[camera] = np.array(sorted(taken), np.int64)
        parts = []
        for some in np.array_split(frames[camera], -(-len(frames[camera]) // 32)):
            images = np.stack([taken[frame] for frame in some.tolist()])
            views = processor.images([images] * len(policy.embodiment.camera_names))
            parts.append(policy.backbone.encode_images(views[:, 0].float() / 255 * 2 - 1).half())
        tokens[camera] = torch.cat(parts)
    readers = [*memories] if policy.memory is None else [policy.memory, *memories]
    memory_images = demonstration.images.get(policy.embodiment.memory_camera, {})
    scores = {}
    for memory in readers:
        if memory.storage.scorer:
            scores[memory.storage.scorer] = _scores(memory, memory_images)
    return FrameTokens(frames, tokens, scores)


def _scores(memory: "Memory", images: Mapping[int, np.ndarray]) -> FrameScores:
    """The scores of these frames by the memory's scorer, as in an episode."""
    scorer = memory.make_scorer()
    assert scorer is not None
    needed = scorer.frames_scored(max(images) + 1).tolist()
    scored = {frame: images[frame] for frame in needed if frame in images}
    return score_frames(scorer, scored, memory.storage.grid**2)


@dataclass(frozen=True)
class TokenStore:
    """The tokens of demonstrations by one tower, a file each, in a folder that is named after the
    tower.

    config: of a policy with the tower, as JSON.
    folder: of all towers' tokens.
    memories: sections, as JSON, of those whose scorers rate frames.
    """

    config: str
    folder: Path
    memories: tuple[str, ...] = ()

    @classmethod
    def of(cls, folder: Path, configs: Sequence[Mapping[str, Any]]) -> "TokenStore":
        """The store of rows that share a tower: their composed configurations."""
        scored = set()
        for config in configs:
            memory = PolicySections.of(config).memory
            if memory:
                section = json.dumps(memory, sort_keys=True)
                if _memory(section).storage.scorer:
                    scored.add(section)
        return cls(json.dumps(dict(configs[0])), folder, tuple(sorted(scored)))

    @property
    def tower(self) -> str:
        """Twelve letters that name the tower."""
        return _policy(self.config).vision_fingerprint()[:12]

    def path(self, file: Path) -> Path:
        """Where the tokens of a demonstration are."""
        return self.folder / self.tower / file.parent.name / f"{file.stem}.safetensors"

    def read(self, file: Path) -> FrameTokens:
        """The tokens of a demonstration, made now if they are not there."""
        self.make(file)
        return FrameTokens.load(self.path(file))

    def make(self, file: Path) -> None:
        """Encode a demonstration unless its tokens are there, of all its frames and with every
        score.
        """
        # The stamp names the demonstration's content and which of its frames are rendered.
        content = hashlib.sha256()
        with np.load(file) as stored:
            for name in stored:
                if not name.endswith("_pictures"):
                    content.update(name.encode())
                    content.update(np.ascontiguousarray(stored[name]).tobytes())
        stamp = content.hexdigest()[:12]
        if not self._is_made(file, stamp):
            scored = map(_memory, self.memories)
            tokenize(_policy(self.config), Demonstration.load(file), scored).save(
                self.path(file), stamp
            )

    def _is_made(self, file: Path, stamp: str) -> bool:
        from safetensors import safe_open

        path = self.path(file)
        if not path.is_file():
            return False
        with safe_open(path, "pt") as tensors:
            scored = set()
            widths = set()
            for name in tensors.keys():  # noqa: SIM118
                kind, _, key = name.partition("/")
                if kind == "scores":
                    scored.add(key)
                elif kind == "tokens":
                    widths.add(tensors.get_slice(name).get_shape()[-1])
            required = {_memory(text).storage.scorer for text in self.memories}
            complete = widths == {_policy(self.config).backbone.vision_width} and required <= scored
            return bool(tensors.metadata().get("stamp") == stamp) and complete


@cache
def _policy(config: str) -> MMEPolicy:
    return mme_of(build_from_config(OmegaConf.create(json.loads(config))), "nanoMME").eval()


@cache
def _memory(section: str) -> "Memory":
    memory: Memory = MEMORIES.build(json.loads(section), d_vision=_SOME_WIDTH, width=_SOME_WIDTH)
    return memory
