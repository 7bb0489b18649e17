"""Memory as modulator: in each action layer, what the norm before the MLP reads is scaled and
shifted by what the layer reads from memory (paper, section 4.3).
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from mme_vla.backbone.base import BackboneConfig, Hook, LayerHooks
from mme_vla.backbone.layers import (
    EPS,
    RMSNorm,
    Rotation,
    additive_mask,
    attend,
    compute_dtype,
    rms_normalise,
    rotate,
    rotation,
    rounded,
)
from mme_vla.errors import check_multiple, check_sizes
from mme_vla.integration.base import Integration, ages_of, checked_position, required
from mme_vla.registry import INTEGRATIONS
from mme_vla.types import MemoryTokens


class ModulatorLayer(nn.Module):
    """One layer's cross-attention on memory, and the linear map from its output to (α, β)."""

    def __init__(
        self, width: int, heads: int, kv_heads: int, head_dim: int, exact_identity: bool
    ) -> None:
        super().__init__()
        self.kv_heads, self.head_dim, self.exact_identity = kv_heads, head_dim, exact_identity
        self.norm = RMSNorm(width)  # shared by queries and memory
        self.q = nn.Linear(width, heads * head_dim, bias=False)
        self.kv = nn.Linear(width, 2 * kv_heads * head_dim, bias=False)
        self.out = nn.Linear(heads * head_dim, width, bias=False)
        self.modulation = nn.Linear(width, 2 * width)
        for layer in (self.q, self.kv, self.out):
            nn.init.normal_(layer.weight, std=layer.in_features**-0.5)
        nn.init.normal_(self.modulation.weight, std=0.0 if exact_identity else 0.002)
        nn.init.zeros_(self.modulation.bias)

    def keys_values(self, memory: Tensor, rope: Rotation) -> tuple[Tensor, Tensor]:
        """Memory [b, m, d] → keys, rotated by `rope`, and values [b, m, K, e]: once per chunk,
        whatever the number of steps.
        """
        kv = self.kv(self.norm(memory)[0]).unflatten(-1, (-1, self.head_dim))
        k, v = kv.chunk(2, dim=-2)
        return rotate(k, rope), v

    def read_memory(
        self, normed: Tensor, k: Tensor, v: Tensor, mask: Tensor, rope: Rotation
    ) -> Tensor:
        """r: what actions, normed [b, h, d], read from memory, their queries rotated by the first h
        of `rope`.
        """
        q = self.q(normed).unflatten(-1, (-1, self.head_dim))
        q = rotate(q, rope.rows(slice(normed.shape[1])))
        return self.out(attend(q, k, v, mask))

    def forward(
        self, x: Tensor, k: Tensor, v: Tensor, mask: Tensor, rope: Rotation, factor: Tensor
    ) -> Tensor:
        """x̂ = x/rms(x)·(1 + α) + β with (α, β) = W r + b. `factor` is the norm's."""
        direction = rms_normalise(x)
        normed = rounded(torch.mul, direction, factor, dtype=x.dtype)
        r = self.read_memory(normed, k, v, mask, rope)
        alpha, beta = self.modulation(r).float().chunk(2, dim=-1)
        if self.exact_identity:
            # The same direction at x's own size: the norm that follows removes it, and α = β = 0
            # gives x to the bit.
            size = (x.float().square().mean(-1, keepdim=True) + EPS).sqrt()
            return rounded(torch.add, x.float() * (1 + alpha), size * beta, dtype=x.dtype)
        return rounded(torch.add, direction * (1 + alpha), beta, dtype=x.dtype)


@INTEGRATIONS.register("modulator")
class Modulator(Integration):
    """Fills the action expert's hook in every layer; the prefix never sees memory."""

    def __init__(
        self,
        backbone: BackboneConfig,
        num_heads: int = 4,
        num_kv_heads: int = 1,
        head_dim: int | None = None,
        exact_identity: bool = False,
        memory_position: str = "slot",
    ) -> None:
        """Build one `ModulatorLayer` per layer.

        Args:
            num_heads, num_kv_heads, head_dim: of the cross-attention; `head_dim` defaults to the
                backbone's.
            exact_identity: start as the memoryless policy to the bit; as released (False) it starts
                near it.
            memory_position: `slot` numbers memory tokens one after the other, as released; `time`
                places a token as many positions before the first action as its frame lies in the
                past, and one.
        """
        super().__init__(backbone)
        self.memory_width = backbone.action.width
        self.memory_position = checked_position(memory_position)
        head_dim = head_dim or backbone.head_dim
        check_sizes(
            "integration", num_heads=num_heads, num_kv_heads=num_kv_heads, head_dim=head_dim
        )
        check_multiple("integration.", "num_heads", num_heads, "num_kv_heads", num_kv_heads)
        check_multiple("integration.", "head_dim", head_dim, "pairs", 2)  # of a rotation
        self.layers = nn.ModuleList(
            ModulatorLayer(self.memory_width, num_heads, num_kv_heads, head_dim, exact_identity)
            for _ in range(backbone.depth)
        )
        self.head_dim, self.horizon = head_dim, backbone.horizon
        self._keys_values: Callable[..., tuple[Tensor, Tensor]] = ModulatorLayer.keys_values

    def compile(self, **options: Any) -> None:
        """Compile the keys and values of memory; what actions read is in their layers' code."""
        self._keys_values = torch.compile(
            ModulatorLayer.keys_values, **{"fullgraph": True, "dynamic": True, **options}
        )

    def hook(self, memory: MemoryTokens | None) -> Hook:
        memory = required(memory)
        tokens = memory.tokens.to(compute_dtype(memory.tokens))
        # Actions have positions after all memory slots, padding included; those of memory count
        # from the same origin.
        n = tokens.shape[1]
        slots = torch.arange(n + self.horizon, device=tokens.device)[None]
        positions = slots[:, :n]
        if self.memory_position == "time":
            positions = n - 1 - ages_of(memory)
        rope = rotation(positions, self.head_dim)
        query_rope = rotation(slots[:, n:], self.head_dim)
        # Every action sees the same keys: b 1 1 m.
        mask = additive_mask(memory.mask[:, None], tokens.dtype)
        # Of all layers at once: these few numbers need three kernels, not two for each layer.
        scales = torch.stack([layer.norm.scale for layer in self.layers])  # type: ignore[union-attr, misc]
        factors = (1 + scales.float()).unbind()
        hooks = []
        for layer, factor in zip(self.layers, factors, strict=True):
            k, v = self._keys_values(layer, tokens, rope)
            hooks.append(partial(layer, k=k, v=v, mask=mask, rope=query_rope, factor=factor))
        return LayerHooks(hooks)
