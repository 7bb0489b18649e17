"""MemoryVLA behind its VLM: perceptual tokens, retrieval from the past, and the diffusion head."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import torch
from torch import Tensor, nn

from mme_vla.backbone.layers import additive_mask
from mme_vla.config.sections import read_section, without
from mme_vla.errors import check_sizes, require
from mme_vla.extras.methods.memoryvla.action_head import Dit, DitConfig, Schedule
from mme_vla.extras.methods.memoryvla.bank import BankState, EpisodeBank, MemoryRetrieval
from mme_vla.extras.methods.openvla_oft.config import FusedVisionConfig, LlamaConfig
from mme_vla.extras.methods.prismatic import Prismatic
from mme_vla.integration.base import required
from mme_vla.memory.extensions.bank import Retrieval
from mme_vla.types import MemoryTokens


def read_moments(
    vlm: Prismatic, images: Tensor, prompt: Tensor, prompt_mask: Tensor
) -> tuple[Tensor, Tensor]:
    """Cognition token [n, 1, d] and vision features [n, p, c] of moments.

    Args:
        images: [n, 3, s, s] in [−1, 1].
        prompt, prompt_mask: [n, l].
    """
    features = vlm.encode_images(images)
    embedded, patches = vlm.embed(prompt), vlm.projector(features)
    tokens = torch.cat([embedded[:, :1], patches.to(embedded), embedded[:, 1:]], 1)
    attention_mask = torch.cat(
        [
            prompt_mask[:, :1],
            torch.ones_like(patches[..., 0], dtype=torch.bool),
            prompt_mask[:, 1:],
        ],
        1,
    )
    n = tokens.shape[1]
    causal = torch.ones(n, n, dtype=torch.bool, device=tokens.device).tril()
    mask = additive_mask(causal & attention_mask[:, None, :], tokens.dtype)
    places = torch.arange(n, device=tokens.device).expand(len(tokens), -1)
    hidden = vlm.read(tokens, mask, places)
    return cognition_token(hidden, features.shape[1], prompt_mask.sum(1)), features


SQUEEZE = 16  # how much narrower the channels' own bottleneck is


class Compression(nn.Module):
    """[b, p, c] → [b, p, d]: reduce, weigh the channels by their mean over the patches, expand."""

    def __init__(self, c: int, middle: int, d: int) -> None:
        super().__init__()
        self.reduce = nn.Linear(c, middle, bias=False)
        self.squeeze = nn.Linear(middle, middle // SQUEEZE)
        self.excite = nn.Linear(middle // SQUEEZE, middle)
        self.expand = nn.Linear(middle, d, bias=False)

    def forward(self, features: Tensor) -> Tensor:
        x = self.reduced(features)
        return self.expand(x * self.weights(x)[:, None])

    def reduced(self, features: Tensor) -> Tensor:
        """Features at the middle width [b, p, m]."""
        return torch.relu(self.reduce(features))

    def weights(self, x: Tensor) -> Tensor:
        """The weight in [0, 1] of each channel [b, m]."""
        return torch.sigmoid(self.excite(torch.relu(self.squeeze(x.mean(1)))))


@dataclass(frozen=True)
class BankConfig:
    """Both banks' options; see `EpisodeBank`. A memory in their place is read by as many layers and
    the same fusion.
    """

    length: int = 16
    retrieval_layers: int = 2
    time_code: bool = True
    fusion: str = "gate"
    consolidation: str = "tome"
    store_fused: bool = False


@dataclass(frozen=True)
class MemoryVlaConfig:
    """Sizes of MemoryVLA, and how its head is trained and asked.

    perceptual_width, compression_width: of a perceptual token, and of the bottleneck's middle.
    repeats: copies of a chunk in training, each with its own noise.
    dropout: how often the cognition token gives way.
    ddim_steps, guidance: of sampling.
    """

    vision: FusedVisionConfig = field(default_factory=FusedVisionConfig)
    vlm: LlamaConfig = field(default_factory=LlamaConfig)
    head: DitConfig = field(default_factory=DitConfig)
    bank: BankConfig = field(default_factory=BankConfig)
    vocab_size: int = 32_064
    perceptual_width: int = 256
    compression_width: int = 512
    action_dim: int = 7
    horizon: int = 16
    repeats: int = 4
    dropout: float = 0.1
    ddim_steps: int = 10
    guidance: float = 1.5

    @classmethod
    def from_dict(cls, section: Mapping[str, Any]) -> Self:
        """Read the section `backbone` of a configuration, but for its `name`."""
        return read_section(cls, without(section, "name"), "backbone")

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, int):
                check_sizes("backbone", **{name: value})
        require(0 <= self.dropout < 1, f"backbone.dropout={self.dropout} must lie in [0, 1).")
        require(
            self.guidance >= 1,
            f"backbone.guidance={self.guidance} must be at least 1 (no guidance).",
        )


@dataclass(frozen=True)
class BankStates:
    """Both banks of one episode, and how many moments they have taken."""

    cognition: BankState
    perceptual: BankState
    count: int = 0


class Core(nn.Module):
    """From cognition and perceptual tokens to a chunk of actions. A subclass defines the memory
    they are fused with.

    Legend: m moments · p patches · widths: c of a vision feature, d of the language model, e of a
    perceptual token.
    """

    def __init__(self, config: MemoryVlaConfig, **past: Retrieval) -> None:
        super().__init__()
        self.config = config
        self.patches = config.vision.grid**2
        d, e = (module.width for module in past.values())
        self.compression = Compression(config.vision.width, config.compression_width, e)
        for name, module in past.items():
            self.add_module(name, module)
        self.head = Dit(config.head, config.action_dim, config.horizon, d, e)
        self.schedule = Schedule.cosine()

    def through(
        self,
        cognition: Tensor,
        features: Tensor,
        times: Tensor,
        sequences: Sequence[Tensor],
        memory: MemoryTokens | None = None,
    ) -> tuple[Tensor, Tensor]:
        """What the head reads of each of m moments: cognition and perceptual tokens, fused with the
        past.

        Args:
            cognition: [m, 1, d].
            features: [m, p, c].
            times: [m].
            sequences: places of the moments that share a bank, in the order of time. Banks read
                these.
            memory: tokens [m, n, e] of each moment's own past, if they replace the banks.
        """
        raise NotImplementedError

    def noise_error(
        self, actions: Tensor, cognition: Tensor, perceptual: Tensor, draws: Mapping[str, Tensor]
    ) -> Tensor:
        """The head's error [r·m, h] on the chunks [m, h, a] of m moments r times over, each time
        with its own noise.

        Args:
            draws: `noise` [r·m, h, a], `steps` [r·m], `drop` [r·m] uniform.
        """
        repeats = len(draws["noise"]) // len(actions)
        actions = actions.repeat(repeats, 1, 1)
        cognition = cognition.repeat(repeats, 1, 1)
        perceptual = perceptual.repeat(repeats, 1, 1)
        noised = self.schedule.noised(actions, draws["noise"], draws["steps"])
        drop = draws["drop"] < self.config.dropout
        predicted = self.head(noised, draws["steps"], cognition, perceptual, drop)
        return (predicted.float() - draws["noise"].float()).square().mean(-1)

    def sample(
        self, noise: Tensor, cognition: Tensor, perceptual: Tensor, steps: int | None = None
    ) -> Tensor:
        """The chunk [b, h, a] that DDIM with guidance makes of noise; nothing is clipped."""

        def predict(x: Tensor, step: int) -> Tensor:
            times = torch.full((len(x),), step, device=x.device)
            return self.head.guided(x, times, cognition, perceptual, self.config.guidance)

        return self.schedule.ddim(noise, steps or self.config.ddim_steps, predict)[-1]


class RecallingCore(Core):
    """A memory of the library stands where the banks' entries stood: the same retrieval reads its
    tokens.

    Its tokens are as wide as perceptual ones; nothing is written.
    """

    cognition_retrieval: MemoryRetrieval
    perceptual_retrieval: MemoryRetrieval

    def __init__(self, config: MemoryVlaConfig) -> None:
        read = config.perceptual_width
        # Without a time code: tokens of a memory carry their own time and place.
        options = (config.bank.retrieval_layers, False, config.bank.fusion, read)
        cognition = MemoryRetrieval(config.vlm.width, *options)
        perceptual = MemoryRetrieval(config.perceptual_width, *options)
        super().__init__(config, cognition_retrieval=cognition, perceptual_retrieval=perceptual)

    def through(
        self,
        cognition: Tensor,
        features: Tensor,
        times: Tensor,
        sequences: Sequence[Tensor],
        memory: MemoryTokens | None = None,
    ) -> tuple[Tensor, Tensor]:
        """See `Core.through`; each moment reads its own memory tokens."""
        past = required(memory)
        read = self.cognition_retrieval.read_memory(past, cognition)
        return read, self.perceptual_retrieval.read_memory(past, self.compression(features))


class MemoryVlaCore(Core):
    """The original: two banks of its own, that are read and written moment by moment."""

    cognition_bank: EpisodeBank
    perceptual_bank: EpisodeBank

    def __init__(
        self, config: MemoryVlaConfig, cognition_bank: EpisodeBank, perceptual_bank: EpisodeBank
    ) -> None:
        super().__init__(config, cognition_bank=cognition_bank, perceptual_bank=perceptual_bank)

    def init_state(self) -> BankStates:
        return BankStates(
            self.cognition_bank.init_state(1), self.perceptual_bank.init_state(self.patches)
        )

    def through(
        self,
        cognition: Tensor,
        features: Tensor,
        times: Tensor,
        sequences: Sequence[Tensor],
        memory: MemoryTokens | None = None,
    ) -> tuple[Tensor, Tensor]:
        """See `Core.through`; each sequence begins with empty banks, which take its moments one
        after the other.
        """
        read = self.cognition_bank.run(cognition, times, sequences)[0]
        return read, self.perceptual_bank.run(self.compression(features), times, sequences)[0]

    def read_banks(
        self, states: Sequence[BankStates], cognition: Tensor, features: Tensor
    ) -> tuple[Tensor, Tensor]:
        """What the head reads of b episodes' current moments: fused cognition [b, 1, d] and
        perceptual tokens.
        """
        cognition_states, perceptual_states = [], []
        for state in states:
            cognition_states.append(state.cognition)
            perceptual_states.append(state.perceptual)
        fused = self.cognition_bank.read(cognition_states, cognition)
        return fused, self.perceptual_bank.read(perceptual_states, self.compression(features))

    def store(self, state: BankStates, cognition: Tensor, features: Tensor) -> BankStates:
        """One episode's banks after the moment [1, d], [p, c]; its time is how many
        went before it.
        """
        fused, perceptual = self.read_banks([state], cognition[None], features[None])
        tokens = self.compression(features[None])[0]
        return BankStates(
            self.cognition_bank.update(state.cognition, cognition, fused[0], state.count),
            self.perceptual_bank.update(state.perceptual, tokens, perceptual[0], state.count),
            state.count + 1,
        )


def cognition_token(hidden: Tensor, patches: int, words: Tensor) -> Tensor:
    """The state that means the moment: of the last word, behind the images' tokens.

    Args:
        hidden: [m, n, d] of `<s>`, patches, words.
        words: [m] how many there are, `<s>` among them.

    Returns:
        [m, 1, d].
    """
    last = (patches + words - 1)[:, None, None].expand(-1, 1, hidden.shape[-1])
    return hidden.gather(1, last)
