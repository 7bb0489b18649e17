"""LAMB as SAM2Act's authors use it: Adam whose update of a tensor is no larger than the tensor."""

from collections.abc import Callable
from typing import Any

from timm.optim.lamb import Lamb


class ClippedLamb(Lamb):
    """timm's LAMB, scaling updates down and never up; it counts its steps in each parameter's
    state, as Adam does.

    timm counts them in the group, which checkpoints do not keep: the correction of the moments'
    bias would start anew.
    """

    def __init__(self, params: Any, **options: Any) -> None:
        super().__init__(params, trust_clip=True, max_grad_norm=None, **options)

    def step(self, closure: Callable[[], float] | None = None) -> Any:
        for group in self.param_groups:
            counts = [
                self.state[p]["step"]
                for p in group["params"]
                if p in self.state and "step" in self.state[p]
            ]
            if counts:
                group["step"] = counts[0].clone()
        loss = super().step(closure)
        for group in self.param_groups:
            for p in group["params"]:
                if p in self.state:
                    self.state[p]["step"] = group["step"].clone()
        return loss
