"""Memory as expert: its own Gemma column, joined to the others by attention alone (paper, section 4.3)."""

from collections.abc import Sequence

from mme_vla.backbone.attention import Block
from mme_vla.backbone.config import BackboneConfig, ExpertConfig
from mme_vla.integration.base import Integration, checked_position, explicit_positions, memory_visibility, required
from mme_vla.registry import INTEGRATIONS
from mme_vla.types import MemoryTokens


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
        """`width` defaults to the action expert's, `mlp_dim` to twice the width: 1024 and 2048 at full size.

        The others are as `Context` has them.
        """
        super().__init__(backbone)
        self.memory_width = width or backbone.action.width
        self.memory_position = checked_position(memory_position)
        self.visibility = memory_visibility(prompt_sees_memory)
        self._expert = ExpertConfig(self.memory_width, mlp_dim or 2 * self.memory_width)

    def extra_experts(self) -> dict[str, ExpertConfig]:
        return {"memory": self._expert}

    def blocks(self, observation: Sequence[Block], memory: MemoryTokens | None) -> list[Block]:
        memory = required(memory)
        positions = explicit_positions(memory, self.memory_position)
        return [Block("memory", memory.tokens, memory.mask, "memory", positions), *observation]
