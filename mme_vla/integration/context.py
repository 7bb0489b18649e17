"""Memory as context: tokens the VLM expert reads before the images (paper, section 4.3)."""

from collections.abc import Sequence

from mme_vla.backbone.layers.blocks import Block
from mme_vla.backbone.pi05.sizes import BackboneConfig
from mme_vla.errors import UserError
from mme_vla.integration.base import Integration, memory_visibility, required
from mme_vla.registry import INTEGRATIONS
from mme_vla.types import MemoryTokens


@INTEGRATIONS.register("context")
class Context(Integration):
    """[memory | images | prompt] in the VLM expert, then actions."""

    def __init__(self, backbone: BackboneConfig, prompt_sees_memory: bool = True) -> None:
        super().__init__(backbone)
        if not prompt_sees_memory and getattr(backbone, "everything_sees_everything", False):
            raise UserError(
                "integration.prompt_sees_memory=false hides memory from the prompt, but in this backbone every token "
                "sees every other: leave it true."
            )
        self.memory_width = backbone.vlm.width
        self.visibility = memory_visibility(prompt_sees_memory)

    def blocks(self, observation: Sequence[Block], memory: MemoryTokens | None) -> list[Block]:
        memory = required(memory)
        return [Block("memory", memory.tokens, memory.mask, "vlm"), *observation]
