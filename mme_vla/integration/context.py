"""Memory as context: tokens the VLM expert reads before the images (paper, section 4.3)."""

from collections.abc import Sequence

from mme_vla.backbone.config import BackboneConfig, ExpertConfig, check_positive
from mme_vla.backbone.layers import Block, Visibility
from mme_vla.errors import require
from mme_vla.integration.base import (
    MEMORY_VISIBILITY,
    Integration,
    checked_position,
    explicit_positions,
    memory_visibility,
    required,
)
from mme_vla.registry import INTEGRATIONS
from mme_vla.types import MemoryTokens

MUTUAL: Visibility = {
    **dict.fromkeys(("memory", "images", "prompt"), frozenset({"memory", "images", "prompt"})),
    "action": MEMORY_VISIBILITY["action"],
}
"""Memory as one of the things that are seen: no block of the prefix is hidden from another."""


@INTEGRATIONS.register("context")
class Context(Integration):
    """[memory | images | prompt] in the VLM expert, then actions."""

    def __init__(
        self,
        backbone: BackboneConfig,
        prompt_sees_memory: bool = True,
        memory_position: str = "slot",
        mutual: bool = False,
    ) -> None:
        """Take the VLM expert's width.

        Args:
            prompt_sees_memory: as released; False as the paper's text.
            memory_position: `slot` numbers memory tokens one after the other, as released; `time`
                places them as many positions before the images as their frames lie in the past.
            mutual: memory stands between images and prompt, and all three see each other, as
                LeRobot's tokens of past states do.
        """
        super().__init__(backbone)
        require(
            not (not prompt_sees_memory and getattr(backbone, "everything_sees_everything", False)),
            "integration.prompt_sees_memory=false hides memory from the prompt, but in this"
            " backbone every token sees every other: leave it true.",
        )
        self.memory_width, self.memory_position = (
            backbone.vlm.width,
            checked_position(memory_position),
        )
        require(
            not (mutual and (memory_position == "time" or not prompt_sees_memory)),
            "integration.mutual=true puts memory between images and prompt, where all see each"
            " other: that goes with memory_position=slot and prompt_sees_memory=true alone.",
        )
        self.mutual = mutual
        self.visibility = MUTUAL if mutual else memory_visibility(prompt_sees_memory)

    def blocks(self, observation: Sequence[Block], memory: MemoryTokens | None) -> list[Block]:
        memory = required(memory)
        positions = explicit_positions(memory, self.memory_position)
        block = Block("memory", memory.tokens, memory.mask, "vlm", positions)
        before = 1 + [block.name for block in observation].index("images") if self.mutual else 0
        return [*observation[:before], block, *observation[before:]]


@INTEGRATIONS.register("expert")
class MemoryExpert(Integration):
    """[memory] in an expert of its own, then [images | prompt] in the VLM expert, then actions."""

    def __init__(
        self,
        backbone: BackboneConfig,
        width: int | None = None,
        mlp_dim: int | None = None,
        prompt_sees_memory: bool = True,
        memory_position: str = "slot",
    ) -> None:
        """`width` defaults to the action expert's, `mlp_dim` to twice the width: 1024 and 2048 at
        full size.

        The others are as `Context` has them.
        """
        super().__init__(backbone)
        self.memory_width = backbone.action.width if width is None else width
        self.memory_position = checked_position(memory_position)
        self.visibility = memory_visibility(prompt_sees_memory)
        self._expert = ExpertConfig(
            self.memory_width, 2 * self.memory_width if mlp_dim is None else mlp_dim
        )
        check_positive(self._expert, "integration.")

    def extra_experts(self) -> dict[str, ExpertConfig]:
        return {"memory": self._expert}

    def blocks(self, observation: Sequence[Block], memory: MemoryTokens | None) -> list[Block]:
        memory = required(memory)
        positions = explicit_positions(memory, self.memory_position)
        return [Block("memory", memory.tokens, memory.mask, "memory", positions), *observation]
