"""The released (JAX) names of the integrations' own tensors. A memory expert's stand in the
backbone's table.
"""

from mme_vla.integration.base import Integration
from mme_vla.integration.modulator import Modulator, ModulatorLayer
from mme_vla.weights.tables import NameTable, Piece, linear, prefixed

LAYERS = "PaliGemma/llm/layers"


def released_names(integration: Integration) -> NameTable:
    """The table of an integration; only the modulator has tensors of its own."""
    table: NameTable = {}
    if not isinstance(integration, Modulator):
        return table
    root = f"{LAYERS}/mem_attn"
    for i, layer in enumerate(integration.layers):
        if not isinstance(layer, ModulatorLayer):
            continue
        heads = {"n": layer.q.out_features // layer.head_dim, "h": layer.head_dim}
        kv_axes = {"two": 2, "k": layer.kv_heads, "h": layer.head_dim}
        kv = Piece(f"{root}/kv_einsum_mem/w", "two k d h -> (two k h) d", kv_axes, i)
        names: NameTable = {
            "norm.scale": [Piece(f"{root}/mem_rms_norm/scale", layer=i)],
            "q.weight": [Piece(f"{root}/q_einsum_mem/w", "n d h -> (n h) d", heads, i)],
            "kv.weight": [kv],
            "out.weight": [Piece(f"{root}/out_einsum_mem/w", "n h d -> d (n h)", heads, i)],
        }
        names |= prefixed("modulation", linear(f"{LAYERS}/mem_rms_norm_ffn/Dense_0", layer=i))
        table |= prefixed(f"layers.{i}", names)
    return table
