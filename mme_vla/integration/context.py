"""Memory as context: tokens the VLM expert reads before the images (paper, section 4.3)."""

from collections.abc import Sequence

from mme_vla.backbone.base import BackboneConfig, ExpertConfig, check_positive
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
"""No block of the prefix is hidden from another, memory included."""


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
        sees_everything = getattr(backbone, "everything_sees_everything", False)
        require(
            prompt_sees_memory or not sees_everything,
            "integration.prompt_sees_memory=false hides memory from the prompt, but in this"
            " backbone every token sees every other: leave it true.",
        )
        self.memory_width = backbone.vlm.width
        self.memory_position = checked_position(memory_position)
        require(
            not mutual or (memory_position == "slot" and prompt_sees_memory),
            "integration.mutual=true puts memory between images and prompt, where all see each"
            " other: that goes with memory_position=slot and prompt_sees_memory=true alone.",
        )
        self.mutual = mutual
        self.visibility = MUTUAL if mutual else memory_visibility(prompt_sees_memory)

    def blocks(self, observation: Sequence[Block], memory: MemoryTokens | None) -> list[Block]:
        memory = required(memory)
        positions = explicit_positions(memory, self.memory_position)
        block = Block("memory", memory.tokens, memory.mask, "vlm", positions)
        if not self.mutual:
            return [block, *observation]
        after_images = [block.name for block in observation].index("images") + 1
        return [*observation[:after_images], block, *observation[after_images:]]


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
        """Take the sizes of the memory's expert.

        Args:
            width: None is the action expert's, 1024 at full size.
            mlp_dim: None is twice the width.
            prompt_sees_memory, memory_position: see `Context`.
        """
        super().__init__(backbone)
        if width is None:
            width = backbone.action.width
        if mlp_dim is None:
            mlp_dim = 2 * width
        self.memory_width = width
        self.memory_position = checked_position(memory_position)
        self.visibility = memory_visibility(prompt_sees_memory)
        self._expert = ExpertConfig(width, mlp_dim)
        check_positive(self._expert, "integration.")

    def extra_experts(self) -> dict[str, ExpertConfig]:
        return {"memory": self._expert}

    def blocks(self, observation: Sequence[Block], memory: MemoryTokens | None) -> list[Block]:
        memory = required(memory)
        positions = explicit_positions(memory, self.memory_position)
        return [Block("memory", memory.tokens, memory.mask, "memory", positions), *observation]
