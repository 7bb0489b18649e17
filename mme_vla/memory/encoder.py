"""From stored vision tokens to memory tokens: 3-D position features and two linear layers (paper, section 4.2)."""

import torch
from torch import Tensor, nn

from mme_vla.errors import require
from mme_vla.memory.base import MemoryModule
from mme_vla.memory.history import StorageSpec
from mme_vla.types import HistoryTokens, MemoryTokens

TEMPORAL_BASE, SPATIAL_BASE = 10_000.0, 1_000.0


def position_features(positions: Tensor, dim: int) -> Tensor:
    """M-RoPE features of (frame, row, column): sin and cos of each axis, side by side.

    [sin tω | cos tω | sin yω′ | cos yω′ | sin xω′ | cos xω′] with
    ω_i = 10000^(−i/(w−1)), ω′_i = 1000^(−i/(w−1)), w = dim/6.

    Args:
        positions: [..., 3] as `HistoryTokens.positions`. dim: a multiple of 6, at least 12.

    Returns:
        [..., dim] float32, computed where the positions are.
    """
    w = dim // 6
    require(
        dim % 6 == 0 and w >= 2, f"position_dim={dim} must be a multiple of 6 (three axes, sin and cos) from 12 on."
    )
    ramp = torch.arange(w, device=positions.device, dtype=torch.float32) / (w - 1)
    frequencies = torch.stack([TEMPORAL_BASE**-ramp, SPATIAL_BASE**-ramp, SPATIAL_BASE**-ramp])  # 3 w
    angles = positions.float()[..., None] * frequencies
    return torch.cat([angles.sin(), angles.cos()], dim=-1).flatten(-2)


def default_position_dim(d_vision: int) -> int:
    """3/8 of the vision width in multiples of 6, at least 48: 768 at full size, as released."""
    return max(48, 6 * (d_vision // 16))


class FeatureEncoder(nn.Module):
    """token = W₂ [feature | SiLU(W₁ position)]: nothing before, between or after, as released.

    Padding (zero feature, zero position) becomes the constant W₂ [0 | SiLU(b₁)]: only the mask tells it apart.
    """

    def __init__(self, d_vision: int, width: int, position_dim: int | None = None, position_hidden: int | None = None):
        super().__init__()
        for name, size in (("position_dim", position_dim), ("position_hidden", position_hidden)):
            require(size is None or size >= 1, f"memory.{name}={size}: must be at least 1, or null for its default.")
        self.position_dim = default_position_dim(d_vision) if position_dim is None else position_dim
        hidden = self.position_dim if position_hidden is None else position_hidden
        self.position = nn.Linear(self.position_dim, hidden)
        self.project = nn.Linear(d_vision + hidden, width)
        for layer in (self.position, self.project):
            nn.init.normal_(layer.weight, std=0.02)
            nn.init.zeros_(layer.bias)

    def encode(self, features: Tensor, position: Tensor) -> Tensor:
        """Encode features [b, n, d_vision] with ready-made position features [b, n, position_dim]."""
        place = nn.functional.silu(self.position(position.to(self.position.weight.dtype)))
        return self.project(torch.cat([features.to(place.dtype), place], dim=-1))

    def forward(self, features: Tensor, positions: Tensor, mask: Tensor) -> Tensor:
        """Encode features at positions [b, n, 3]; padding gets zero position features, not those of (0, 0, 0)."""
        return self.encode(features, position_features(positions, self.position_dim) * mask[..., None])


class PerceptualMemory(MemoryModule):
    """Selected tokens, right-padded to the budget and encoded one by one; subclasses choose."""

    timed = True

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int,
        storage: StorageSpec,
        position_dim: int | None = None,
        position_hidden: int | None = None,
    ) -> None:
        """Build the encoder.

        Args:
            d_vision: width of a vision token. width: of a memory token, given by the integration.
            budget: most memory tokens. storage: what is kept of each frame.
            position_dim, position_hidden: widths of the position features and their layer; None follows `d_vision`.
        """
        super().__init__()
        self.budget = self.capacity = budget
        self.storage = storage
        self.encoder = FeatureEncoder(d_vision, width, position_dim, position_hidden)

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        tokens = self.encoder(history.features, history.positions, history.mask)
        return MemoryTokens(tokens, history.mask, ages=history.ages)
