"""`Integration`: the one package that knows both memory and backbone."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import ClassVar

from torch import Tensor, nn

from mme_vla.backbone.base import BackboneConfig, ExpertConfig, Hook, Injection
from mme_vla.backbone.layers import PI05_VISIBILITY, Block, Visibility
from mme_vla.errors import check_choice
from mme_vla.types import MemoryTokens

MEMORY_VISIBILITY: Visibility = {
    "memory": {"memory"},
    "images": {"images", "prompt"},
    "prompt": {"memory", "images", "prompt"},
    "action": {"memory", "images", "prompt", "action"},
}
"""As released, wherever memory is a block. In the paper's text the prompt does not see memory.
"""


def memory_visibility(prompt_sees_memory: bool) -> Visibility:
    """Return the table; without `prompt_sees_memory` as the paper's text has it."""
    if prompt_sees_memory:
        return MEMORY_VISIBILITY
    return {**MEMORY_VISIBILITY, "prompt": PI05_VISIBILITY["prompt"]}


MEMORY_POSITIONS = ("slot", "time")


def checked_position(memory_position: str) -> str:
    """The value of `integration.memory_position`; raises `UserError` unless it is one."""
    check_choice("integration.memory_position", memory_position, MEMORY_POSITIONS)
    return memory_position


class Integration(nn.Module):
    """Where memory tokens enter the backbone. This base class adds nothing: π0.5 without memory.

    A subclass overrides what it needs:
        memory_width: width of the memory tokens it takes (0: it takes none).
        visibility: the table for its block list.
        extra_experts: experts the backbone has to have besides its own two.
        blocks: the prefix's block list, memory in its place.
        hook: the action expert's per-layer hook for this chunk, with all that depends on memory
            alone computed now.
        condition: what becomes of the condition of the action expert's norms (the embedded flow
            time).
        beside: blocks that enter with the actions in every step; `visibility` needs rows for them.
        required_features: what a backbone must support beside the methods overridden here
            (`Backbone.supports`).
        memory_position: `time` where its attention on memory counts frames, which needs a memory
            that is `timed`; `slot` where it counts tokens.
    """

    memory_width: int = 0
    visibility: Visibility = PI05_VISIBILITY
    required_features: ClassVar[frozenset[str]] = frozenset()
    memory_position: str = "slot"

    def __init__(self, backbone: BackboneConfig) -> None:
        super().__init__()

    def extra_experts(self) -> dict[str, ExpertConfig]:
        return {}

    def blocks(self, observation: Sequence[Block], memory: MemoryTokens | None) -> list[Block]:
        return list(observation)

    def hook(self, memory: MemoryTokens | None) -> Hook | None:
        return None

    def condition(self, memory: MemoryTokens | None) -> Callable[[Tensor], Tensor] | None:
        return None

    def beside(self, memory: MemoryTokens | None) -> Sequence[Block]:
        return ()

    def inject(self, observation: Sequence[Block], memory: MemoryTokens | None) -> Injection:
        """Collect what enters the backbone for one chunk.

        Args:
            observation: the backbone's blocks.
            memory: the memory's tokens; None without memory.
        """
        return Injection(
            self.blocks(observation, memory),
            self.visibility,
            self.hook(memory),
            self.condition(memory),
            self.beside(memory),
        )


def explicit_positions(memory: MemoryTokens, memory_position: str) -> Tensor | None:
    """Rotary positions of memory tokens by the age of their frames, [b, budget] float32; None
    numbers them by slots.

    The current frame has the last position before the blocks that follow, and a frame t frames ago
    lies t positions before it. So the distance between two tokens does not depend on the other
    tokens in memory.
    """
    if memory_position == "slot":
        return None
    current_frame = memory.mask.sum(1, keepdim=True) - 1
    return current_frame - ages_of(memory)


def ages_of(memory: MemoryTokens) -> Tensor:
    """How many frames ago each memory token's frame was, [b, budget]."""
    if memory.ages is None:
        raise ValueError(
            "memory_position=time: these memory tokens have no ages (HistoryTokens.step was not"
            " given)."
        )
    return memory.ages


EXTENSION_POINTS = {name: name for name in ("blocks", "hook", "condition", "beside")} | {
    "extra_experts": "expert"
}
"""Method of an integration → the feature that a backbone must support for it
(`Backbone.supports`).
"""


def extension_points(kind: type[Integration]) -> frozenset[str]:
    """The features of a backbone that an integration uses, known before it is built to the
    backbone's sizes.
    """
    features = set(kind.required_features)
    for name, feature in EXTENSION_POINTS.items():
        is_overridden = getattr(kind, name) is not getattr(Integration, name)
        if is_overridden:
            features.add(feature)
    return frozenset(features)


def required(memory: MemoryTokens | None) -> MemoryTokens:
    """The memory tokens, zero where the mask is False; raises `ValueError` if there are none.

    What stands there is undefined, even NaN, and attention without a valid key reads all alike.
    """
    if memory is None:
        raise ValueError(
            "This policy has a memory: batch.history must hold its selection (it is None)."
        )
    return replace(memory, tokens=memory.tokens.masked_fill(~memory.mask[..., None], 0))
