"""An episode of SimpleMemVLA: the frames its video may show, their tokens, and the next prompt's
beginning.

The timestamps of a window keep their places while its images move on, so the language model reads a
new window whole. What does not depend on the newest frames is read between two decisions
(`advance`), which changes no action.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from mme_vla.errors import UserError
from mme_vla.extras.methods.simplememvla.model import Prefill, VideoLanguageModel
from mme_vla.extras.methods.simplememvla.prompt import VIDEO, Tokens
from mme_vla.policy.episode import Episode
from mme_vla.types import FrameBatch

if TYPE_CHECKING:
    from mme_vla.extras.methods.simplememvla.policy import SimpleMemVlaPolicy

PIECE = 8
"""Temporal patches that one call of `advance` reads."""
Pair = tuple[int, int]
"""The two frames of a temporal patch."""


@dataclass
class Ahead:
    """The beginning of the prompt at a later step, as far as it was read.

    step: the frame at which it is used.
    pairs: its temporal patches.
    tokens: the prompt.
    """

    step: int
    pairs: list[Pair]
    tokens: Tokens
    cache: Any
    patches: int = 0
    length: int = 0


@dataclass
class VideoMemory:
    """What an episode keeps of its video, as far back as a window reaches.

    frames: index → [3, H, W] uint8.
    patches: the tokens [m, D] of temporal patches.
    ahead: see `Ahead`.
    """

    frames: dict[int, Tensor] = field(default_factory=dict)
    patches: dict[Pair, Tensor] = field(default_factory=dict)
    ahead: Ahead | None = None


class VideoEpisode(Episode):
    """Recent frames of the memory camera beside the current view."""

    policy: "SimpleMemVlaPolicy"

    def __init__(self, policy: "SimpleMemVlaPolicy", goal: str, seed: int = 0) -> None:
        super().__init__(policy, goal, seed)
        self.video = VideoMemory()
        self.subtask = ""
        """The sub-task that the policy generated for its last chunk."""

    def _take(
        self,
        frames: FrameBatch,
        demo: np.ndarray,
        executed: np.ndarray,
        states: np.ndarray | None = None,
    ) -> None:
        start = self.n_observed_frames
        processor = self.policy.require_processor()
        oldest = start + len(demo) - 1
        if processor.shows_video:
            oldest -= processor.window.span
        for i in range(max(oldest - start, 0), len(demo)):
            if (image := frames.image(i)) is not None:
                self.video.frames[start + i] = torch.from_numpy(np.moveaxis(image, -1, 0).copy())
        super()._take(frames, demo, executed, states)
        # What lies before the window is dropped.
        video = self.video
        video.frames = {k: image for k, image in video.frames.items() if k >= oldest}
        video.patches = {pair: t for pair, t in video.patches.items() if pair[0] >= oldest}

    @property
    def step(self) -> int:
        """The current frame."""
        if not self.n_observed_frames:
            raise UserError(
                "No frame was observed yet: call observe() with the current frame before act()."
            )
        return self.n_observed_frames - 1

    def pairs(self, step: int) -> list[Pair]:
        """The temporal patches that are shown at a step."""
        frames = self.policy.require_processor().frames(step).tolist()
        return list(zip(frames[::2], frames[1::2], strict=True))

    def images_of(self, pairs: Sequence[Pair]) -> Tensor:
        """Temporal patches [n, 2, 3, h, w] uint8 of frames that were observed."""
        numbers = list(chain.from_iterable(pairs))
        missing = sorted(set(numbers) - set(self.video.frames))
        if missing:
            raise UserError(
                f"The video shows the frames {missing[:5]}, which were not rendered or not"
                " observed: observe() those that frames_read() names."
            )
        frames = torch.stack([self.video.frames[frame] for frame in numbers])
        return self.policy.require_processor().video(frames)

    def encode(self, model: VideoLanguageModel, pairs: Sequence[Pair]) -> Tensor:
        """The tokens [n, m, D] of temporal patches; those read before are kept."""
        new = [pair for pair in dict.fromkeys(pairs) if pair not in self.video.patches]
        if new:
            encoded = model.encode_patches(self.images_of(new).to(model.embedding.weight.device))
            self.video.patches |= dict(zip(new, encoded, strict=True))
        return torch.stack([self.video.patches[pair] for pair in pairs])

    def plan(self, step: int, tokens: Tokens, model: VideoLanguageModel) -> bool:
        """Begin to read the prompt at a later step; return whether its beginning was observed, and
        rendered.
        """
        pairs = self.pairs(step)
        rendered = self.video.frames.keys() >= set(chain.from_iterable(pairs[:-1]))
        if not tokens.prefix or not rendered:
            return False
        self.video.ahead = Ahead(step, pairs, tokens, model.new_cache())
        return True

    def advance(self, model: VideoLanguageModel) -> bool:
        """Read some more temporal patches of the planned prompt; return whether more remain."""
        ahead = self.video.ahead
        assert ahead is not None
        count = len(ahead.pairs) - 1
        tokens = ahead.tokens
        if ahead.patches == count:
            return False
        last = min(ahead.patches + PIECE, count)
        features = self.encode(model, ahead.pairs[ahead.patches : last])
        kinds = torch.from_numpy(tokens.kinds) == VIDEO
        end = int(torch.nonzero(kinds)[last * features.shape[1] - 1]) + 1
        place = slice(ahead.length, end)
        device = features.device
        ids = torch.from_numpy(tokens.ids[place].copy()).to(device)[None]
        positions = torch.from_numpy(tokens.positions[:, place].copy()).to(device)[None]
        embedded = model.embed(ids, (kinds[place][None].to(device), features.flatten(0, 1)))
        model.hidden(embedded, positions, ahead.cache)
        ahead.patches, ahead.length = last, end
        return last < count

    def take_prefill(self, tokens: Tokens) -> Prefill | None:
        """What was read ahead of the current prompt, for one use; None if another was planned."""
        ahead, self.video.ahead = self.video.ahead, None
        if ahead is None or not ahead.length or ahead.step != self.step:
            return None
        if not np.array_equal(ahead.tokens.ids[: ahead.length], tokens.ids[: ahead.length]):
            return None
        return Prefill(ahead.cache, ahead.length)
