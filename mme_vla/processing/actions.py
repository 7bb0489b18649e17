"""What the network predicts: joint targets relative to the current state, and the gripper as it is."""

from torch import Tensor
from torch.nn import functional

JOINTS = 7  # the arm; what follows (the gripper) stays absolute


def to_deltas(actions: Tensor, state: Tensor) -> Tensor:
    """Express a chunk relative to one state: the same reference for all its steps.

    Args:
        actions: [..., h, 8] absolute joint targets and the gripper command.
        state: [..., 8] joint angles and the gripper reading when the chunk begins.

    Returns:
        [..., h, 8]: joints relative, gripper absolute.
    """
    return _shift(actions, -state)


def to_absolute(actions: Tensor, state: Tensor) -> Tensor:
    """Invert `to_deltas`."""
    return _shift(actions, state)


def pad_width(x: Tensor, width: int) -> Tensor:
    """Append zeros to the last dimension until it is `width` long."""
    return functional.pad(x, (0, width - x.shape[-1]))


def _shift(actions: Tensor, state: Tensor) -> Tensor:
    out = actions.clone()
    out[..., :JOINTS] += state[..., None, :JOINTS].to(actions)
    return out
