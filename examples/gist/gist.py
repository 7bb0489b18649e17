"""An integration of one's own: the memory's gist joins the time condition, its tokens stand beside
the actions.
"""

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor, nn

from mme_vla import Integration, MemoryTokens, register
from mme_vla.backbone.layers import PI05_VISIBILITY, Block
from mme_vla.integration.base import required


@register("integration", "gist")
class Gist(Integration):
    """Mean of the memory → condition of every action norm; all of it → tokens that the actions
    attend to.
    """

    def __init__(self, backbone: Any) -> None:
        super().__init__(backbone)
        self.memory_width = backbone.action.width
        self.to_condition = nn.Linear(self.memory_width, self.memory_width)
        visible = {"images", "prompt", "memory"}
        self.visibility = {**PI05_VISIBILITY, "memory": visible, "action": visible | {"action"}}

    def condition(self, memory: MemoryTokens | None) -> Callable[[Tensor], Tensor]:
        memory = required(memory)
        valid = memory.mask[..., None]
        mean = memory.tokens.masked_fill(~valid, 0).sum(1) / valid.sum(1).clamp(min=1)
        change = self.to_condition(mean)  # once a chunk
        return lambda condition: condition + change

    def beside(self, memory: MemoryTokens | None) -> Sequence[Block]:
        memory = required(memory)
        return [Block("memory", memory.tokens, memory.mask, "action")]
