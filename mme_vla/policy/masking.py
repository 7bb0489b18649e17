"""The loss of a chunk whose last actions may be no recorded ones (`data.mask_padding`)."""

from torch import Tensor


def masked_mean(losses: Tensor, counted: Tensor | None) -> Tensor:
    """The mean of losses [b, h] over what counts, of each sample first: it does not matter with which it is computed.

    Args:
        counted: [b, h] bool; None counts all.
    """
    if counted is None:
        return losses.mean()
    weights = counted.to(losses.dtype)
    return ((losses * weights).sum(1) / weights.sum(1).clamp(min=1)).mean()
