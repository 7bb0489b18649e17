"""`MemoryVlaPolicy`: a VLM's cognition token and vision features, two memory banks, a diffusion head."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from mme_vla.backbone.base import Draws, map_draws, stack_draws
from mme_vla.backbone.layers.attention import additive_mask
from mme_vla.backbone.layers.recomputing import Recompute
from mme_vla.backbone.openvla.prismatic import Prismatic
from mme_vla.backbone.openvla.vision import IMAGENET
from mme_vla.backbone.shard_groups import ShardGroup
from mme_vla.config.sections import read_section
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import UserError, brief
from mme_vla.memory.bank import MemoryBank
from mme_vla.policy.base import Policy
from mme_vla.policy.episode import Episode
from mme_vla.policy.kinds import policy_options
from mme_vla.policy.memoryvla.core import BankStates, MemoryVlaConfig, MemoryVlaCore, cognition_token
from mme_vla.policy.memoryvla.episode import MemoryVlaEpisode, words
from mme_vla.policy.memoryvla.processing import GroupBatch, MemoryVlaProcessor
from mme_vla.policy.tensor_files import dtype_of
from mme_vla.processing.base import PolicyProcessor
from mme_vla.processing.openvla_pictures import augment, centre_cut, draw_changes
from mme_vla.processing.pictures import to_unit_range
from mme_vla.registry import POLICIES


@POLICIES.register("memoryvla")
class MemoryVlaPolicy(Policy):
    """MemoryVLA: what a moment means (one token of a Llama) and what it looks like (tokens of two towers), each with a
    bank of past moments that is read, fused and written; a diffusion transformer answers.

    Training sees groups of moments of one episode, each group in banks of its own; acting writes moment by moment.
    """

    memory = None
    heads = ("core",)
    adapted = ("attn.qkv", "attn.proj", "q_proj", "k_proj", "v_proj", "o_proj", "gate_proj", "up_proj", "down_proj")
    unadaptable = r"^core\."
    PARTS: ClassVar[Mapping[str, str]] = {
        "vision": r"vlm\.vision\.",
        "vlm": r"vlm\.",
        "memory": r"core\.(cognition_bank|perceptual_bank|compression)\.",
        "action": "",
    }

    acts_in_bfloat16 = True

    def __init__(
        self,
        vlm: Prismatic,
        core: MemoryVlaCore,
        processor: MemoryVlaProcessor | None = None,
        config: Mapping[str, Any] | None = None,
        *,
        compute_dtype: str = "float32",
        history_dtype: str = "bfloat16",
        augment: bool = True,
    ) -> None:
        """Put the parts together.

        Args:
            processor: needed for episodes and data; the network alone runs on ready batches without it.
            config: what `from_config` was given; saved with the weights.
            compute_dtype: `bfloat16` runs matmuls under autocast over the float32 master weights.
            history_dtype: unused here; banks hold what the network computes.
            augment: crop and colour pictures while training.
        """
        super().__init__()
        self.vlm, self.core, self.processor = vlm, core, processor
        self.config, self.sizes = dict(config or {}), core.config
        self.compute_dtype = dtype_of(compute_dtype, "policy.compute_dtype")
        self.augment = augment
        self.horizon, self.action_dim = core.config.horizon, core.config.action_dim
        self.sample_steps = core.config.ddim_steps

    @classmethod
    def from_config(
        cls, config: Mapping[str, Any], processor: PolicyProcessor | None = None, *, fresh_backbone: bool = True
    ) -> Self:
        """Build from plain sections `backbone`, `embodiment`, `policy`.

        Raises:
            UserError: an unknown option, sizes that do not fit together, or a memory beside its own banks.
        """
        section = {key: value for key, value in config["backbone"].items() if key != "name"}
        sizes = read_section(MemoryVlaConfig, section, "backbone")
        embodiment_of(config).check_network(sizes.action_dim, sizes.horizon)
        if config.get("memory") or config.get("integration"):
            raise UserError("MemoryVLA has banks of its own (backbone.bank): leave memory and integration at none.")
        if processor is not None and not isinstance(processor, MemoryVlaProcessor):
            raise UserError("MemoryVLA needs its own processor: set processor=memoryvla, or memoryvla_tiny to try it.")
        with nullcontext() if fresh_backbone else torch.device("meta"):
            vlm = Prismatic(sizes.vision, sizes.vlm, sizes.vocab_size, IMAGENET)
            banks = (MemoryBank(width, **vars(sizes.bank)) for width in (sizes.vlm.width, sizes.perceptual_width))
            core = MemoryVlaCore(sizes, *banks)
        if not fresh_backbone:
            for module in (vlm, core):
                module.to_empty(device=torch.get_default_device())
        return cls(vlm, core, processor, config, **policy_options(cls, config))

    def autocast(self) -> torch.autocast:
        """The context all network code runs in."""
        kind = self.device.type if self.device.type != "meta" else "cpu"
        return torch.autocast(kind, self.compute_dtype, enabled=self.compute_dtype != torch.float32)

    # Moments

    def moments(self, pictures: Tensor, prompt: Tensor, prompt_mask: Tensor) -> tuple[Tensor, Tensor]:
        """Cognition token [n, 1, d] and vision features [n, p, c] of moments.

        Args:
            pictures: [n, 3, s, s] in [−1, 1]. prompt, prompt_mask: [n, l].
        """
        features = self.vlm.encode_images(pictures)
        embedded, patches = self.vlm.embed(prompt), self.vlm.projector(features)
        tokens = torch.cat([embedded[:, :1], patches.to(embedded), embedded[:, 1:]], 1)
        seen = torch.cat(
            [prompt_mask[:, :1], torch.ones_like(patches[..., 0], dtype=torch.bool), prompt_mask[:, 1:]], 1
        )
        n = tokens.shape[1]
        causal = torch.ones(n, n, dtype=torch.bool, device=tokens.device).tril()
        mask = additive_mask(causal & seen[:, None, :], tokens.dtype)
        places = torch.arange(n, device=tokens.device).expand(len(tokens), -1)
        hidden = self.vlm.read(tokens, mask, places)
        return cognition_token(hidden, features.shape[1], prompt_mask.sum(1)), features

    def _of_batch(self, batch: GroupBatch, changes: Tensor | None = None) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Moments of a batch without its padding, and the places of each group among them.

        Args:
            changes: [g, m', 6] of the pictures, m' ≥ m; by default the middle is cut out.
        """
        pictures = batch.images[batch.valid]
        if changes is None:
            shown = centre_cut(pictures)
        else:
            shown = augment(pictures, changes[:, : batch.valid.shape[1]][batch.valid])
        with self.autocast():
            told = (batch.prompt[batch.valid], batch.prompt_mask[batch.valid])
            cognition, features = self.moments(to_unit_range(shown), *told)
        counts = batch.valid.sum(1).tolist()
        return cognition, features, list(torch.arange(sum(counts)).split(counts))

    # Training

    @property
    def group_size(self) -> int:
        """Moments of a training sample: its processor's, else its configuration's."""
        return self.config["processor"]["group_size"] if self.processor is None else self.processor.group_size

    def loss_draws(self, count: int, generator: torch.Generator) -> Draws:
        """Of `count` groups: `noise` [n, r, m, h, a], `steps` and `drop` [n, r, m], for r copies of m moments."""
        shape = (count, self.sizes.repeats, self.group_size)
        return {
            "noise": torch.randn(*shape, self.horizon, self.action_dim, generator=generator),
            "steps": torch.randint(len(self.core.schedule), shape, generator=generator),
            "drop": torch.rand(shape, generator=generator),
        }

    def picture_draws(self, count: int, generator: torch.Generator) -> Draws:
        """While training with augmentation `changes` [n, m, 6]: what happens to the pictures of `count` groups."""
        if not (self.training and self.augment):
            return {}
        size = self.group_size
        return {"changes": draw_changes(count * size, generator).unflatten(0, (count, size))}

    def forward(self, batch: GroupBatch, draws: Mapping[str, Tensor] | None = None) -> tuple[Tensor, dict[str, Tensor]]:
        """The mean squared error of the predicted noise over all moments, copies and numbers.

        Args:
            batch: with `actions`. draws: as `loss_draws` and `picture_draws` make them; fresh ones by default.
        """
        if batch.actions is None:
            raise ValueError("forward() computes a loss: batch.actions must hold the recorded chunks (it is None).")
        given = dict(draws or self.loss_draws(len(batch.images), torch.default_generator))
        if "changes" not in given:
            given |= self.picture_draws(len(batch.images), torch.default_generator)
        changes = given.pop("changes", None)
        copies = batch.valid.shape[1]

        def whole_batch_over(value: Tensor) -> Tensor:  # copies of the whole batch, one after the other
            return value[:, :, :copies].transpose(0, 1)[:, batch.valid].flatten(0, 1)

        drawn = map_draws(given, lambda value: whole_batch_over(value.to(self.device)))
        cognition, features, groups = self._of_batch(batch, None if changes is None else changes.to(self.device))
        with self.autocast():
            actions, times = batch.actions[batch.valid], batch.times[batch.valid]
            losses = self.core.loss(cognition, features, actions, times, groups, drawn)
        loss = losses.mean()
        return loss, {"loss": loss.detach()}

    def recompute(self, wanted: Recompute) -> None:
        """Recompute the language model's layers in the backward pass."""
        self.vlm.recompute(wanted)

    def shard_groups(self) -> Sequence[ShardGroup]:
        """Towers, word embedding, every layer of the language model, and every block of the head."""
        whole = (self.vlm.vision, self.vlm.language.model.embed_tokens)
        layers = (*self.vlm.language.model.layers, *self.core.head.blocks)
        return [*(ShardGroup(module, full=True) for module in whole), *map(ShardGroup, layers)]

    def compile(self, **options: Any) -> None:
        """Compile the towers, the language model's layers and the head's blocks, each by itself."""
        towers, layers = (self.vlm.vision.dino, self.vlm.vision.siglip), self.vlm.language.model.layers
        for module in (*towers, *layers, *self.core.head.blocks):
            module.compile(**options)

    # Sampling

    def sample_draws(self, generator: torch.Generator) -> Draws:
        """The starting `noise` [h, a]."""
        return {"noise": torch.randn(self.horizon, self.action_dim, generator=generator)}

    @torch.no_grad()
    def sample_actions(
        self, batch: GroupBatch, draws: Mapping[str, Tensor] | None = None, steps: int | None = None
    ) -> Tensor:
        """A normalised chunk [g, h, a] for the last moment of every group, through the moments before it."""
        if draws is None:
            draws = stack_draws([self.sample_draws(torch.default_generator) for _ in range(len(batch.images))])
        cognition, features, groups = self._of_batch(batch)
        with self.autocast():
            times = batch.times[batch.valid]
            read, _ = self.core.cognition_bank.run(cognition, times, groups)
            seen, _ = self.core.perceptual_bank.run(self.core.compression(features), times, groups)
            last = [int(group[-1]) for group in groups]
            return self.core.sample(draws["noise"].to(self.device), read[last], seen[last], steps)

    # Episodes

    def start_episode(self, goal: str, seed: int = 0) -> MemoryVlaEpisode:
        """Begin an episode with empty banks."""
        return MemoryVlaEpisode(self, goal, seed)

    def observation(self, episodes: Sequence[Episode]) -> GroupBatch:
        """The current moments of running episodes, each a group of one."""
        pictures = torch.stack([_own(episode).moment for episode in episodes])
        ids, masks = words([episode.prompt for episode in episodes])
        times = torch.tensor([_own(episode).banks.count for episode in episodes])
        valid = torch.ones(len(episodes), 1, dtype=torch.bool)
        return GroupBatch(pictures[:, None], ids[:, None], masks[:, None], times[:, None], valid).to(self.device)

    def answer(
        self, batch: GroupBatch, episodes: Sequence[Episode], draws: Mapping[str, Tensor], steps: int | None = None
    ) -> Tensor:
        """A chunk for what `observation` saw, through the episodes' banks, which it leaves as they are."""
        with torch.no_grad():
            cognition, features, _ = self._of_batch(batch)
            with self.autocast():
                read, seen = self.core.look([_own(episode).banks for episode in episodes], cognition, features)
                chunk = self.core.sample(draws["noise"].to(self.device), read, seen, steps)
        for i, episode in enumerate(episodes):
            _own(episode).asked = (cognition[i], features[i])
        return chunk

    @torch.no_grad()
    def write(self, banks: BankStates, frames: np.ndarray, prompt: tuple[Tensor, Tensor]) -> BankStates:
        """Banks after further frames [n, H, W, 3] uint8 of the camera that the policy looks through."""
        processor = self.require_processor()
        pictures = processor.resized(frames).to(self.device)
        ids, mask = (part.to(self.device).expand(len(frames), -1) for part in prompt)
        with self.autocast():
            cognition, features = self.moments(to_unit_range(centre_cut(pictures)), ids, mask)
            for i in range(len(frames)):
                banks = self.core.store(banks, cognition[i], features[i])
        return banks

    def require_processor(self) -> MemoryVlaProcessor:
        """Return the processor, or say what it takes to have one."""
        processor = super().require_processor()
        assert isinstance(processor, MemoryVlaProcessor)
        return processor

    def check_processor(self, source: str) -> None:
        """See `Saved`."""
        super().check_processor(source)
        processor, sizes = self.require_processor(), self.sizes
        pairs = {
            "image_size": (processor.image_size, sizes.vision.image_size),
            "action_dim": (processor.action_dim, sizes.action_dim),
            "horizon": (processor.horizon, sizes.horizon),
        }
        for name, (found, expected) in pairs.items():
            if found != expected:
                raise UserError(
                    f"{source}: the processor's {name} is {brief(found)}, the network's {expected}. The files are from "
                    "two checkpoints, or one was changed."
                )

    # Costs and parts

    def full_batch(self, device: torch.device | str = "cpu") -> GroupBatch:
        """A group of one moment without content, with the longest prompt; where it is, is known on meta too."""
        size, length = self.sizes.vision.image_size, int(self.config["processor"]["prompt_length"])
        length += self.embodiment.action.options_length
        known = "cpu" if torch.device(device).type == "meta" else device
        return GroupBatch(
            images=torch.zeros(1, 1, 3, size, size, dtype=torch.uint8, device=device),
            prompt=torch.full((1, 1, length), 5, device=device),
            prompt_mask=torch.ones(1, 1, length, dtype=torch.bool, device=device),
            times=torch.zeros(1, 1, dtype=torch.int64, device=known),
            valid=torch.ones(1, 1, dtype=torch.bool, device=known),
            actions=torch.zeros(1, 1, self.horizon, self.action_dim, device=device),
        )

    def see_empty_frame(self) -> None:
        """Run the vision towers on one black frame."""
        size = self.sizes.vision.image_size
        self.vlm.encode_images(torch.zeros(1, 3, size, size, device=self.device))

    def parts(self) -> Mapping[str, str]:
        """Towers; projector and language model; banks and compression; the head."""
        return self.PARTS


def _own(episode: Episode) -> MemoryVlaEpisode:
    assert isinstance(episode, MemoryVlaEpisode)
    return episode
