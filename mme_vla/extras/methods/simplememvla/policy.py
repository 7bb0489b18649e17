"""`SimpleMemVlaPolicy`: a video-language model generates the sub-task; its words' hidden states
condition a flow.
"""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mme_vla.backbone.base import FineTuneSpec
from mme_vla.backbone.building import shapes_only
from mme_vla.backbone.flow import EULER_STEPS
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import UserError
from mme_vla.extras.methods.network import MethodPolicy, processor_for
from mme_vla.extras.methods.simplememvla.config import SimpleMemVlaSizes
from mme_vla.extras.methods.simplememvla.episode import VideoEpisode
from mme_vla.extras.methods.simplememvla.head import ActionHead, Condition
from mme_vla.extras.methods.simplememvla.model import (
    Prefill,
    VideoLanguageModel,
    WordIds,
    response_condition,
    words_loss,
)
from mme_vla.extras.methods.simplememvla.processor import (
    SimpleMemVlaProcessor,
    VideoBatch,
    processor_settings,
)
from mme_vla.extras.methods.simplememvla.prompt import (
    IMAGE,
    MEMORY,
    TEXT,
    VIDEO,
    CameraTokens,
    Tokens,
    rope_positions,
)
from mme_vla.extras.methods.simplememvla.video import TEMPORAL, Window, augment, augmentation_draw
from mme_vla.memory.base import MemoryModule, full_history
from mme_vla.policy.base import draw_noise
from mme_vla.policy.build import build_memory, check_past
from mme_vla.policy.episode import Episode
from mme_vla.policy.network import MemoryTower
from mme_vla.policy.saving import policy_options
from mme_vla.policy.sections import PolicySections
from mme_vla.processing.base import PolicyProcessor
from mme_vla.registry import POLICIES
from mme_vla.speed import Recompute
from mme_vla.speed.sharding import ShardGroup
from mme_vla.types import MemoryTokens, Noise, map_noise

_STAMP_TOKENS, _REQUEST_TOKENS, _RESPONSE_TOKENS = 9, 105, 12
"""Text tokens of a timestamp, of a prompt's remaining text and of a response, where costs are
counted.
"""


@POLICIES.register("simplememvla")
class SimpleMemVlaPolicy(MethodPolicy):
    """SimpleMemVLA: no memory module but a time-stamped video in the prompt, sub-task words, and a
    flow head on them.

    A memory of the library may replace the video: its tokens, projected, stand where the video's
    would.
    """

    acts_in_bfloat16 = True
    finetune_spec = FineTuneSpec(
        components={
            "vision": r"backbone\.model\.visual\.",
            "vlm": r"backbone\.",
            "memory": r"memory\.|memory_proj\.",
            "action": "",
        },
        lora_targets=(
            "q_proj",
            "k_proj",
            "v_proj",
            "o_proj",
            "in_proj_qkv",
            "in_proj_z",
            "linear_attn.out_proj",
            "gate_proj",
            "up_proj",
            "down_proj",
        ),
        full_train=("action_head",),
        lora_exclude=r"^action_head\.",
    )

    def __init__(
        self,
        sizes: SimpleMemVlaSizes,
        memory: MemoryModule | None = None,
        processor: SimpleMemVlaProcessor | None = None,
        config: Mapping[str, Any] | None = None,
        *,
        fresh_backbone: bool = True,
        **options: Any,
    ) -> None:
        """Build the network; `processor`, `config` and `options` as for `NetworkPolicy`.

        Args:
            memory: in the video's place.
            fresh_backbone: initialise the language model's weights.
        """
        super().__init__(processor, config, **options)
        with nullcontext() if fresh_backbone else shapes_only():
            self.backbone = VideoLanguageModel(sizes.qwen)
        if not fresh_backbone:
            self.backbone.to_empty(device=torch.get_default_device())
            self.backbone.reset_buffers()
        self.action_head = ActionHead(
            sizes.head, sizes.width, sizes.action_dim, sizes.horizon, sizes.state_dim
        )
        self.memory, self.sizes = memory, sizes
        self.memory_proj = None
        if memory is not None:
            self.memory_proj = nn.Linear(sizes.memory_width, sizes.width)
        self.horizon, self.action_dim = sizes.horizon, sizes.action_dim
        self.info = replace(
            self.info,
            sample_steps=EULER_STEPS,
            processor_sizes={
                "factor": sizes.factor,
                "image_side": sizes.image_size,
                "memory_tokens": 0 if memory is None else memory.budget,
                "embodiment.action.horizon": sizes.horizon,
            },
        )

    @classmethod
    def from_config(
        cls,
        config: Mapping[str, Any],
        processor: PolicyProcessor | None = None,
        *,
        fresh_backbone: bool = True,
    ) -> Self:
        sections = PolicySections.of(config)
        sizes = SimpleMemVlaSizes.from_dict(sections.backbone)
        robot = embodiment_of(config)
        robot.check_network(sizes.action_dim, sizes.horizon)
        if sizes.state_dim not in (0, robot.state.width):
            raise UserError(
                f"backbone.state_dim={sizes.state_dim} must be {robot.state.width}, or 0 for no"
                " state."
            )
        if sections.integration:
            raise UserError(
                "SimpleMemVLA has no place for the integration"
                f" {sections.integration.get('name')!r}: a memory's tokens stand in the prompt, in"
                " place of the video. Set integration=none."
            )
        processor = processor_for(
            SimpleMemVlaProcessor, processor, "simplememvla, or simplememvla_tiny to try it"
        )
        memory: MemoryModule | None = None
        if sections.memory:
            grid = sizes.image_size // sizes.factor
            memory = build_memory(sections.memory, sizes.width, grid, sizes.memory_width)
            check_past(sections, memory, frozenset())
            if not memory.budget:
                raise UserError(
                    f"The memory {sections.memory['name']!r} has no tokens with these settings."
                )
        options = policy_options(cls, config)
        return cls(sizes, memory, processor, config, fresh_backbone=fresh_backbone, **options)

    # The network

    def embed(
        self, batch: VideoBatch, memory: MemoryTokens | None = None, changes: Tensor | None = None
    ) -> Tensor:
        """Embeddings [b, L, D] of prompts, with images and memory tokens in them.

        Args:
            changes: [b, 7] uniform numbers that augment the images of each row.
        """
        video, images = batch.video, batch.images
        if changes is not None:
            video, images = _augmented(video, images, batch.patches, changes)
        replaced: list[tuple[Tensor, Tensor]] = []
        pairs = images.flatten(0, 1)[:, None].expand(-1, TEMPORAL, -1, -1, -1)
        if len(pairs):
            tokens = self.backbone.encode_patches(pairs)
            replaced.append((batch.kinds == IMAGE, tokens.flatten(0, 1)))
        features = batch.features
        if features is None and video is not None and len(video):
            features = self.backbone.encode_patches(video)
        if features is not None:
            replaced.append((batch.kinds == VIDEO, features.flatten(0, 1)))
        if memory is not None:
            assert self.memory_proj is not None
            # Empty tokens are zero before the projection.
            filled = torch.where(memory.mask[..., None], memory.tokens.float(), 0.0)
            replaced.append((batch.kinds == MEMORY, self.memory_proj(filled).flatten(0, 1)))
        return self.backbone.embed(batch.ids, *replaced)

    # Training

    def training_noise(self, count: int, generator: torch.Generator) -> Noise:
        """`noise` [n, h, a] and flow times `time` [n] of Beta(alpha, 1), 1 = noise."""
        uniform = torch.rand(count, generator=generator)
        noise = torch.randn(count, self.horizon, self.action_dim, generator=generator)
        return {"noise": noise, "time": uniform ** (1 / self.sizes.head.time_alpha)}

    def augmentation_params(self, count: int, generator: torch.Generator) -> Noise:
        """While training with augmentation `changes` [n, 7]: uniform numbers for the images of
        `count` samples.
        """
        if not (self.training and self.augment):
            return {}
        return {"changes": torch.rand(count, 7, generator=generator)}

    def forward(
        self, batch: VideoBatch, noise: Mapping[str, Tensor] | None = None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The flow's loss and the cross entropy of the sub-task's words, weighted and added.

        Args:
            batch: with responses and `actions`.
            noise: of `training_noise` and `augmentation_params`.
        """
        if batch.actions is None:
            raise ValueError(
                "forward() computes a loss: batch.actions must hold the recorded chunk (it is"
                " None)."
            )
        values = dict(noise or self.training_noise(len(batch.ids), torch.default_generator))
        if "changes" not in values:
            values |= self.augmentation_params(len(batch.ids), torch.default_generator)
        values = map_noise(values, lambda value: value.to(self.device))
        changes = values.pop("changes", None)
        memory = self.encode_memory(batch.history)
        with self.autocast():
            embedded = self.embed(batch, memory, changes)
            hidden = self.backbone.hidden(embedded, batch.positions)
            words, right = words_loss(self.backbone, hidden, batch.ids, batch.spans)
            condition = response_condition(hidden, embedded, batch.positions, batch.spans)
            action = self.action_head.loss(
                batch.actions,
                condition,
                self._state(batch),
                values["noise"],
                values["time"],
                batch.action_mask,
            )
        loss = self.sizes.action_weight * action + self.sizes.words_weight * words
        metrics = {
            "loss": loss.detach(),
            "action": action.detach(),
            "words": words.detach(),
            "words_right": right,
        }
        if memory is not None:
            metrics |= memory.logged()
        return loss, metrics

    def _state(self, batch: VideoBatch) -> Tensor | None:
        return batch.state if self.sizes.state_dim else None

    def recompute(self, mode: Recompute) -> None:
        self.backbone.recompute(mode)

    def shard_groups(self) -> Sequence[ShardGroup]:
        """The vision tower, every layer of the language model, and every block of the head,
        gathered in float32.

        Decay rates of delta nets are not rounded.
        """
        tower, layers = self.backbone.model.visual, self.backbone.model.language_model.layers
        return [
            ShardGroup(module, full=True) for module in (tower, *layers, *self.action_head.blocks)
        ]

    # Sampling

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        """The starting `noise` [h, a]."""
        return {"noise": torch.randn(self.horizon, self.action_dim, generator=generator)}

    @torch.no_grad()
    def sample_actions(
        self,
        batch: VideoBatch,
        noise: Mapping[str, Tensor] | None = None,
        steps: int | None = None,
        memory: MemoryTokens | None = None,
    ) -> Tensor:
        """A normalised chunk [b, h, a] under words that the policy generates; responses in the
        batch are not read.

        Args:
            memory: memory tokens encoded beforehand.
        """
        if noise is None:
            noise = draw_noise(self, len(batch.ids))
        memory = self.encode_memory(batch.history) if memory is None else memory
        _, condition = self.generate(batch, memory)
        return self._sample(batch, condition, noise, steps)

    def _sample(
        self,
        batch: VideoBatch,
        condition: Condition,
        noise: Mapping[str, Tensor],
        steps: int | None,
    ) -> Tensor:
        with self.autocast():
            start = noise["noise"].to(self.device)
            return self.action_head.sample(
                start, condition, self._state(batch), steps or self.info.sample_steps
            )

    @torch.no_grad()
    def generate(
        self, batch: VideoBatch, memory: MemoryTokens | None = None, prefill: Prefill | None = None
    ) -> tuple[list[list[int]], Condition]:
        """The ids of the sub-tasks that the policy generates, and their hidden states.

        Args:
            prefill: the beginning of the one prompt of the batch.
        """
        with self.autocast():
            embedded = self.embed(batch, memory)
            longest = max(batch.prompts)
            start = 0
            if prefill is not None:
                start = prefill.length
            rows, places = [], []
            for row, place, length in zip(embedded, batch.positions, batch.prompts, strict=True):
                rows.append(functional.pad(row[:length], (0, 0, longest - length, 0)))
                places.append(functional.pad(place[:, :length], (longest - length, 0)))
            mask = None
            if min(batch.prompts) < longest:
                lengths = torch.tensor(batch.prompts, device=embedded.device)
                mask = torch.arange(longest, device=embedded.device) >= (longest - lengths)[:, None]
            if batch.words is None:
                processor = self.require_processor()
                ends, limit = processor.word_ids, processor.settings.max_words
            else:  # of words that are known any number is read, and none ends them
                ends, limit = WordIds(0, 0), max(map(len, batch.words))
            return self.backbone.generate(
                torch.stack(rows)[:, start:],
                torch.stack(places)[..., start:],
                ends,
                limit,
                mask,
                prefill,
                batch.words,
            )

    # Episodes

    def start_episode(self, goal: str, seed: int = 0) -> Episode:
        """Begin an episode; without a memory it keeps the frames that the video may show."""
        return VideoEpisode(self, goal, seed)

    def observation(self, episodes: Sequence[Episode]) -> VideoBatch:
        """The prompts and current images of running episodes, without the tokens of
        their videos.
        """
        processor, robot = self.require_processor(), self.embodiment
        others = [i for i, name in enumerate(robot.camera_names) if name != robot.memory_camera]
        tokens = [self._tokens(_video_episode(episode)) for episode in episodes]
        images = [episode.images[others] for episode in episodes]
        states = processor.states(torch.stack([episode.state for episode in episodes]))
        return processor.batch(tokens, images, states).to(self.device)

    def _tokens(self, episode: VideoEpisode, step: int | None = None) -> Tokens:
        """The prompt of an episode, now or at a later step."""
        processor = self.require_processor()
        pairs = episode.pairs(episode.step if step is None else step)
        shape = episode.images_of(episode.pairs(episode.step)[-1:]).shape
        size, current = (shape[-2], shape[-1]), (episode.images.shape[-2], episode.images.shape[-1])
        return processor.tokens(episode.prompt, len(pairs), size, current)

    @torch.no_grad()
    def predict_chunk(
        self,
        batch: VideoBatch,
        episodes: Sequence[Episode],
        noise: Mapping[str, Tensor],
        steps: int | None = None,
    ) -> Tensor:
        """A chunk for each episode; prompts that were read ahead are continued one by one, the
        others in one batch.
        """
        running = [_video_episode(episode) for episode in episodes]
        features = []
        with self.autocast():
            for episode in running:
                features.append(episode.encode(self.backbone, episode.pairs(episode.step)))
        memory = self.encode_memories(episodes)
        prefills = [episode.take_prefill(self._tokens(episode)) for episode in running]

        # Episodes with a prefill go alone, all others in one batch.
        groups: list[list[int]] = []
        together: list[int] = []
        for i, prefill in enumerate(prefills):
            if prefill is None:
                together.append(i)
            else:
                groups.append([i])
        if together:
            groups.append(together)

        chunks: dict[int, Tensor] = {}
        for group in groups:
            index = torch.tensor(group)
            rows = index.to(self.device)
            part = replace(batch.rows(rows), features=torch.cat([features[i] for i in group]))
            part_memory = None if memory is None else memory.rows(rows)
            responses, condition = self.generate(part, part_memory, prefills[group[0]])
            chunk = self._sample(part, condition, {"noise": noise["noise"][index]}, steps)
            chunks |= dict(zip(group, chunk, strict=True))
            for i, words in zip(group, responses, strict=True):
                running[i].subtask = self.require_processor().tokenizer.decode(words).strip()
        return torch.stack([chunks[i] for i in range(len(running))])

    @torch.no_grad()
    def prepare(self, episode: Episode) -> bool:
        """Read some of the prompt at the next decision, or what the memory reads; return whether
        more remains.
        """
        processor = self.require_processor()
        if not processor.shows_video:
            return super().prepare(episode)
        running = _video_episode(episode)
        if not running.n_observed_frames:
            return False
        step = running.step + self.embodiment.action.execute
        if self.embodiment.action.frames is None:
            return False  # the next decision may be at any frame
        with self.autocast():
            if running.video.ahead is None or running.video.ahead.step != step:
                running.video.ahead = None
                if not running.plan(step, self._tokens(running, step), self.backbone):
                    return False
            return running.advance(self.backbone)

    def frames_read(self, steps: np.ndarray, exec_start: int) -> np.ndarray:
        """Frames of the video, or those that the memory reads."""
        processor = self.require_processor()
        if self.memory is not None:
            return self.memory.frames_read(steps, exec_start)
        if not processor.shows_video or not len(steps):
            return np.zeros(0, np.int64)
        return np.unique(np.concatenate([processor.frames(int(step)) for step in steps]))

    def require_processor(self) -> SimpleMemVlaProcessor:
        processor = super().require_processor()
        assert isinstance(processor, SimpleMemVlaProcessor)
        return processor

    @property
    def memory_tower(self) -> MemoryTower:
        self.require_memory()
        return MemoryTower(
            self.backbone.model.visual,
            self._encode_images,
            self.sizes.width,
            self.sizes.image_size,
            ("one image",),
        )

    def _encode_images(self, images: Tensor) -> Tensor:
        return self.backbone.encode_patches(images[:, None].expand(-1, TEMPORAL, -1, -1, -1))

    # Costs

    def full_batch(self, device: torch.device | str = "cpu") -> VideoBatch:
        """A batch of one without content: a full video, or a full memory, and a response of a usual
        length.
        """
        sizes, robot = self.sizes, self.embodiment
        settings = processor_settings(self.config)
        window = Window(settings.seconds, settings.fps, settings.native_fps)
        patches, n_memory, history = 1, 0, None
        if self.memory is not None:
            n_memory = self.memory.budget
            history = full_history(self.memory, sizes.width, device)
        elif settings.video:
            patches = window.length // TEMPORAL
        side = settings.side or sizes.image_size
        grid = (side // sizes.factor, side // sizes.factor)
        n_images, n_tokens = len(robot.cameras) - 1, grid[0] * grid[1]
        # The prompt: memory and video, current images, request and response
        kinds_of_tokens = [TEXT] + [MEMORY] * n_memory
        kinds_of_tokens += ([TEXT] * _STAMP_TOKENS + [VIDEO] * n_tokens) * patches
        kinds_of_tokens += ([TEXT] + [IMAGE] * n_tokens) * n_images
        kinds_of_tokens += [TEXT] * (_REQUEST_TOKENS + _RESPONSE_TOKENS)
        kinds = np.array(kinds_of_tokens)
        cameras = [CameraTokens("front", grid, [0.0] * patches)]
        cameras += [CameraTokens("wrist", grid)] * n_images
        length = len(kinds)
        return VideoBatch(
            ids=torch.zeros(1, length, dtype=torch.int64, device=device),
            kinds=torch.from_numpy(kinds)[None].to(device),
            positions=torch.from_numpy(rope_positions(kinds, cameras))[None].to(device),
            prompts=(length - _RESPONSE_TOKENS,),
            lengths=(length,),
            patches=(patches,),
            state=torch.zeros(1, robot.state.width, device=device),
            images=torch.zeros(1, n_images, 3, side, side, dtype=torch.uint8, device=device),
            video=torch.zeros(patches, TEMPORAL, 3, side, side, dtype=torch.uint8, device=device),
            actions=torch.zeros(1, self.horizon, self.action_dim, device=device),
            history=history,
            words=((1,) * (_RESPONSE_TOKENS - 2),),
        )


def _augmented(
    video: Tensor | None, images: Tensor, patches: Sequence[int], changes: Tensor
) -> tuple[Tensor | None, Tensor]:
    """The video [K, 2, 3, H, W] and the images [b, c, 3, H, W] of each row, all changed alike."""
    videos = None if video is None else video.split(list(patches))
    changed_images, changed_videos = [], []
    for i, row in enumerate(changes.tolist()):
        draw = augmentation_draw(row)
        changed_images.append(augment(images[i], draw))
        if videos is not None:
            frames = augment(videos[i].flatten(0, 1), draw)
            changed_videos.append(frames.unflatten(0, (-1, TEMPORAL)))
    if changed_videos:
        video = torch.cat(changed_videos)
    return video, torch.stack(changed_images)


def _video_episode(episode: Episode) -> VideoEpisode:
    assert isinstance(episode, VideoEpisode)
    return episode
