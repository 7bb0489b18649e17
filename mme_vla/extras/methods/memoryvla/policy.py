"""`MemoryVlaPolicy`: a VLM's cognition token and vision features, two banks or any memory, a
diffusion head.
"""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from mme_vla.backbone.base import FineTuneSpec
from mme_vla.backbone.building import shapes_only
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import UserError, require
from mme_vla.extras.methods.memoryvla.bank import EpisodeBank
from mme_vla.extras.methods.memoryvla.episode import MemoryVlaEpisode
from mme_vla.extras.methods.memoryvla.model import (
    BankStates,
    Core,
    MemoryVlaConfig,
    MemoryVlaCore,
    RecallingCore,
    read_moments,
)
from mme_vla.extras.methods.memoryvla.processor import GroupBatch, MemoryVlaProcessor
from mme_vla.extras.methods.network import MethodPolicy, processor_for
from mme_vla.extras.methods.openvla_oft.processor import augment, centre_cut, draw_changes
from mme_vla.extras.methods.prismatic import IMAGENET, Prismatic
from mme_vla.memory.base import Memory, full_history
from mme_vla.model import masked_mean
from mme_vla.policy.base import draw_noise
from mme_vla.policy.build import build_memory, check_past
from mme_vla.policy.episode import Episode
from mme_vla.policy.network import MemoryTower
from mme_vla.policy.saving import policy_options
from mme_vla.policy.sections import PolicySections
from mme_vla.processing.base import PolicyProcessor
from mme_vla.registry import POLICIES
from mme_vla.speed import Recompute, compile_parts
from mme_vla.speed.sharding import ShardGroup
from mme_vla.types import MemoryTokens, Noise, map_noise, to_unit_range


@POLICIES.register("memoryvla")
class MemoryVlaPolicy(MethodPolicy):
    """MemoryVLA: what a moment means (one token of a Llama) and what it looks like (tokens of two
    towers), each with a bank of past moments that is read, fused and written. A diffusion
    transformer predicts the chunk.

    Training sees groups of moments of one episode, each group in banks of its own; acting writes
    moment by moment. A memory of the library may replace the banks: each moment then reads its own
    history's tokens.
    """

    acts_in_bfloat16 = True
    finetune_spec = FineTuneSpec(
        components={
            "vision": r"vlm\.vision\.",
            "vlm": r"vlm\.",
            "memory": r"memory\.|core\.((cognition|perceptual)_(bank|retrieval)|compression)\.",
            "action": "",
        },
        lora_targets=(
            "attn.qkv",
            "attn.proj",
            "q_proj",
            "k_proj",
            "v_proj",
            "o_proj",
            "gate_proj",
            "up_proj",
            "down_proj",
        ),
        full_train=("core",),
        lora_exclude=r"^core\.",
    )

    def __init__(
        self,
        vlm: Prismatic,
        core: Core,
        memory: Memory | None = None,
        processor: MemoryVlaProcessor | None = None,
        config: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        """Put the parts together; `processor`, `config` and `options` as for `NetworkPolicy`.

        Args:
            core: with banks, or for a memory (`RecallingCore`).
        """
        super().__init__(processor, config, **options)
        self.vlm, self.core, self.memory = vlm, core, memory
        self.sizes = core.config
        self.horizon, self.action_dim = core.config.horizon, core.config.action_dim
        sizes = core.config
        self.info = replace(
            self.info,
            sample_steps=sizes.ddim_steps,
            processor_sizes={
                "image_size": sizes.vision.image_size,
                "action_dim": sizes.action_dim,
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
        sizes = MemoryVlaConfig.from_dict(sections.backbone)
        embodiment_of(config).check_network(sizes.action_dim, sizes.horizon)
        if sections.integration:
            name = sections.integration.get("name")
            raise UserError(
                f"MemoryVLA has no place for the integration {name!r}: its own retrieval reads a"
                " memory, in place of its banks. Set integration=none."
            )
        processor = processor_for(
            MemoryVlaProcessor, processor, "memoryvla, or memoryvla_tiny to try it"
        )
        is_alone = processor is not None and processor.group_size == 1
        require(
            sections.memory or not is_alone,
            "processor.group_size=1: MemoryVLA's banks learn from moments that follow each other;"
            " give groups of 2 or more, or a memory in place of the banks (memory=framesamp).",
        )
        with nullcontext() if fresh_backbone else shapes_only():
            vlm = Prismatic(sizes.vision, sizes.vlm, sizes.vocab_size, IMAGENET)
        if not fresh_backbone:
            vlm.to_empty(device=torch.get_default_device())
        # Drawn in any case: OpenVLA, to start from, has none.
        core: Core
        if sections.memory:
            core = RecallingCore(sizes)
        else:
            cognition = EpisodeBank(sizes.vlm.width, **vars(sizes.bank))
            perceptual = EpisodeBank(sizes.perceptual_width, **vars(sizes.bank))
            core = MemoryVlaCore(sizes, cognition, perceptual)
        memory: Memory | None = None
        if sections.memory:
            memory = build_memory(
                sections.memory, sizes.vision.width, sizes.vision.grid, sizes.perceptual_width
            )
            check_past(sections, memory, frozenset())
        return cls(vlm, core, memory, processor, config, **policy_options(cls, config))

    # Moments

    def _of_batch(
        self, batch: GroupBatch, changes: Tensor | None = None
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Moments of a batch without its padding, and the places of each group among them.

        Args:
            changes: [g, m', 6] of the images, m' ≥ m; by default the middle is cut out.
        """
        images = batch.images[batch.valid]
        if changes is None:
            cropped = centre_cut(images)
        else:
            cropped = augment(images, changes[:, : batch.valid.shape[1]][batch.valid])
        with self.autocast():
            prompt = (batch.prompt[batch.valid], batch.prompt_mask[batch.valid])
            cognition, features = read_moments(self.vlm, to_unit_range(cropped), *prompt)
        counts = batch.valid.sum(1).tolist()
        return cognition, features, list(torch.arange(sum(counts)).split(counts))

    @property
    def banked(self) -> MemoryVlaCore:
        """The core, where it has banks of its own."""
        assert isinstance(self.core, MemoryVlaCore)
        return self.core

    # Training

    @property
    def group_size(self) -> int:
        """Moments of a training sample: its processor's, else its configuration's."""
        if isinstance(self.processor, MemoryVlaProcessor):
            return self.processor.group_size
        return int(PolicySections.of(self.config).processor["group_size"])

    def training_noise(self, count: int, generator: torch.Generator) -> Noise:
        """Of `count` groups: `noise` [n, r, m, h, a], `steps` and `drop` [n, r, m], for r copies of
        m moments.
        """
        shape = (count, self.sizes.repeats, self.group_size)
        return {
            "noise": torch.randn(*shape, self.horizon, self.action_dim, generator=generator),
            "steps": torch.randint(len(self.core.schedule), shape, generator=generator),
            "drop": torch.rand(shape, generator=generator),
        }

    def augmentation_params(self, count: int, generator: torch.Generator) -> Noise:
        """While training with augmentation `changes` [n, m, 6]: what happens to the images of
        `count` groups.
        """
        if not (self.training and self.augment):
            return {}
        size = self.group_size
        return {"changes": draw_changes(count * size, generator).unflatten(0, (count, size))}

    def forward(
        self, batch: GroupBatch, noise: Mapping[str, Tensor] | None = None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The mean squared error of the predicted noise over all moments, copies and numbers.

        Args:
            batch: with `actions`.
            noise: of `training_noise` and `augmentation_params`; fresh ones by default.
        """
        if batch.actions is None:
            raise ValueError(
                "forward() computes a loss: batch.actions must hold the recorded chunks (it is"
                " None)."
            )
        values = dict(noise or self.training_noise(len(batch.images), torch.default_generator))
        if "changes" not in values:
            values |= self.augmentation_params(len(batch.images), torch.default_generator)
        changes = values.pop("changes", None)
        if changes is not None:
            changes = changes.to(self.device)
        longest = batch.valid.shape[1]

        def of_moments(value: Tensor) -> Tensor:  # copies of the whole batch, one after the other
            copied = value.to(self.device)[:, :, :longest].transpose(0, 1)
            return copied[:, batch.valid].flatten(0, 1)

        sampled = map_noise(values, of_moments)
        memory = self.encode_memory(batch.histories())
        cognition, features, groups = self._of_batch(batch, changes)
        with self.autocast():
            read, perceptual = self.core.through(
                cognition, features, batch.times[batch.valid], groups, memory
            )
            # r·m h
            losses = self.core.noise_error(batch.actions[batch.valid], read, perceptual, sampled)
        counted = None
        if batch.action_mask is not None:
            mask = batch.action_mask[batch.valid]
            counted = mask.repeat(len(losses) // len(mask), 1)
        loss = masked_mean(losses, counted)
        metrics = {"loss": loss.detach()}
        if memory is not None:
            metrics |= memory.logged()
        return loss, metrics

    def recompute(self, mode: Recompute) -> None:
        self.vlm.recompute(mode)

    def shard_groups(self) -> Sequence[ShardGroup]:
        language = self.vlm.language.model
        return [
            ShardGroup(self.vlm.vision, full=True),
            ShardGroup(language.embed_tokens, full=True),
            *map(ShardGroup, (*language.layers, *self.core.head.blocks)),
        ]

    def compile(self, **options: Any) -> None:
        """Compile the towers, the language model's layers and the head's blocks, each by itself."""
        towers = (self.vlm.vision.dino, self.vlm.vision.siglip)
        for module in (*towers, *self.vlm.language.model.layers, *self.core.head.blocks):
            module.compile(**options)
        compile_parts(self.memory, **options)

    # Sampling

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        """The starting `noise` [h, a]."""
        return {"noise": torch.randn(self.horizon, self.action_dim, generator=generator)}

    @torch.no_grad()
    def sample_actions(
        self,
        batch: GroupBatch,
        noise: Mapping[str, Tensor] | None = None,
        steps: int | None = None,
        memory: MemoryTokens | None = None,
    ) -> Tensor:
        """A normalised chunk [g, h, a] for the last moment of every group: through those before it,
        or its own memory.

        Args:
            memory: memory tokens of the last moments, encoded beforehand.
        """
        if noise is None:
            noise = draw_noise(self, len(batch.images))
        if self.memory is not None:
            batch = batch.last()
            memory = self.encode_memory(batch.history) if memory is None else memory
        cognition, features, groups = self._of_batch(batch)
        with self.autocast():
            read, perceptual = self.core.through(
                cognition, features, batch.times[batch.valid], groups, memory
            )
            last = [int(group[-1]) for group in groups]
            return self.core.sample(
                noise["noise"].to(self.device), read[last], perceptual[last], steps
            )

    # Episodes

    def start_episode(self, goal: str, seed: int = 0) -> Episode:
        """Begin an episode with empty banks, or an empty memory."""
        if self.memory is not None:
            return super().start_episode(goal, seed)
        return MemoryVlaEpisode(self, goal, seed)

    def frames_read(self, steps: np.ndarray, exec_start: int) -> np.ndarray | None:
        """What a memory reads; with banks any frame, since those of the video enter them."""
        if self.memory is None:
            return None
        return super().frames_read(steps, exec_start)

    def observation(self, episodes: Sequence[Episode]) -> GroupBatch:
        """The current moments of running episodes, each a group of one; only banks know what number
        theirs has.
        """
        images, ids, masks = [], [], []
        times = torch.zeros(len(episodes), 1, dtype=torch.int64)
        for i, episode in enumerate(episodes):
            images.append(episode.images)
            ids.append(episode.prompt[0])
            masks.append(episode.prompt[1])
            if self.memory is None:
                times[i] = _memoryvla_episode(episode).banks.count
        batch = GroupBatch(
            images=self.require_processor().prepare_images(torch.stack(images))[:, None],
            prompt=torch.stack(ids)[:, None],
            prompt_mask=torch.stack(masks)[:, None],
            times=times,
            valid=torch.ones(len(episodes), 1, dtype=torch.bool),
        )
        return batch.to(self.device)

    def predict_chunk(
        self,
        batch: GroupBatch,
        episodes: Sequence[Episode],
        noise: Mapping[str, Tensor],
        steps: int | None = None,
    ) -> Tensor:
        """A chunk for what `observation` saw, through the episodes' memories, or their banks, which
        it leaves alone.
        """
        if self.memory is not None:
            return self.sample_actions(batch, noise, steps, self.encode_memories(episodes))
        with torch.no_grad():
            cognition, features, _ = self._of_batch(batch)
            with self.autocast():
                read, perceptual = self.banked.read_banks(
                    [_memoryvla_episode(episode).banks for episode in episodes], cognition, features
                )
                chunk = self.core.sample(noise["noise"].to(self.device), read, perceptual, steps)
        for i, episode in enumerate(episodes):
            _memoryvla_episode(episode).pending = (cognition[i], features[i])
        return chunk

    @torch.no_grad()
    def write(
        self, banks: BankStates, frames: np.ndarray, prompt: tuple[Tensor, Tensor]
    ) -> BankStates:
        """Banks after further frames [n, H, W, 3] uint8 of the camera that the policy looks
        through.
        """
        processor = self.require_processor()
        images = processor.resized(frames).to(self.device)
        ids, mask = (part.to(self.device).expand(len(frames), -1) for part in prompt)
        with self.autocast():
            cognition, features = read_moments(
                self.vlm, to_unit_range(centre_cut(images)), ids, mask
            )
            for i in range(len(frames)):
                banks = self.banked.store(banks, cognition[i], features[i])
        return banks

    @torch.no_grad()
    def store(self, banks: BankStates, cognition: Tensor, features: Tensor) -> BankStates:
        """Banks after the moment at which a chunk was chosen, [1, d] and [p, c]."""
        with self.autocast():
            return self.banked.store(banks, cognition, features)

    def require_processor(self) -> MemoryVlaProcessor:
        processor = super().require_processor()
        assert isinstance(processor, MemoryVlaProcessor)
        return processor

    @property
    def memory_tower(self) -> MemoryTower:
        vlm, sizes = self.vlm, self.sizes.vision
        image_format = ""
        if isinstance(self.processor, MemoryVlaProcessor):
            image_format = self.processor.memory_image_format
        settings = (image_format, str(vlm.vision.dino_standard))
        return MemoryTower(vlm.vision, vlm.encode_images, sizes.width, sizes.image_size, settings)

    # Costs

    def full_batch(self, device: torch.device | str = "cpu") -> GroupBatch:
        """A group of one moment without content, with the longest prompt and a full memory.

        Where the moment is, is known on meta too.
        """
        size = self.sizes.vision.image_size
        length = int(PolicySections.of(self.config).processor["prompt_length"])
        length += self.embodiment.action.options_length
        known = "cpu" if torch.device(device).type == "meta" else device
        history = None
        if self.memory is not None:
            history = full_history(self.memory, self.sizes.vision.width, device)
        return GroupBatch(
            images=torch.zeros(1, 1, 3, size, size, dtype=torch.uint8, device=device),
            prompt=torch.full((1, 1, length), 5, device=device),
            prompt_mask=torch.ones(1, 1, length, dtype=torch.bool, device=device),
            times=torch.zeros(1, 1, dtype=torch.int64, device=known),
            valid=torch.ones(1, 1, dtype=torch.bool, device=known),
            actions=torch.zeros(1, 1, self.horizon, self.action_dim, device=device),
            history=history,
        )


def _memoryvla_episode(episode: Episode) -> MemoryVlaEpisode:
    assert isinstance(episode, MemoryVlaEpisode)
    return episode
