"""The last step before the network: actions as wide as it takes them. What they mean is the embodiment's business."""

from torch import Tensor
from torch.nn import functional


def pad_width(x: Tensor, width: int) -> Tensor:
    """Append zeros to the last dimension until it is `width` long."""
    return functional.pad(x, (0, width - x.shape[-1]))
