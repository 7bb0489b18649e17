"""The released (JAX) names of the backbone's tensors. VLM leaves have no suffix, the action
expert's end in `_1`.
"""

from mme_vla.backbone.base import BackboneConfig
from mme_vla.backbone.gemma import ExpertLayer
from mme_vla.backbone.pi05 import Pi05Backbone
from mme_vla.weights.tables import NameTable, Piece, Unread, linear, prefixed

LAYERS = "PaliGemma/llm/layers"
SUFFIX = {"vlm": "", "action": "_1", "memory": "_mem"}


def released_names(backbone: Pi05Backbone) -> NameTable:
    """The backbone's table, a released memory expert included; names are relative to
    the backbone.
    """
    table: NameTable = {"embedding.weight": [Piece("PaliGemma/llm/embedder/input_embedding")]}
    table |= prefixed("vision.vit", _vision(backbone.config))
    for i, block in enumerate(backbone.transformer.layers):
        for expert, layer in block.experts.items():  # type: ignore[union-attr, operator]
            if expert not in SUFFIX:
                continue  # of an integration of one's own
            names = _expert_layer(backbone.config, layer, SUFFIX[expert], i)
            table |= prefixed(f"transformer.layers.{i}.experts.{expert}", names)
    table |= prefixed("transformer.final_norm.dense", linear("PaliGemma/llm/final_norm_1/Dense_0"))
    for target, source in (("action_in", "action_in_proj"), ("action_out", "action_out_proj"),
                         ("time_in", "time_mlp_in"), ("time_out", "time_mlp_out")):  # fmt: skip
        table |= prefixed(target, linear(source))
    return table


def released_unread(backbone: Pi05Backbone) -> list[Unread]:
    """What the released trees hold and no action reads: final norms, and the last layer but for its
    keys and values.
    """
    config = backbone.config
    heads = config.num_heads
    h = config.head_dim
    last = config.depth - 1
    gaps = []
    for name, expert in backbone.transformer.experts.items():
        if name in SUFFIX and name != backbone.transformer.action_expert:
            suffix = SUFFIX[name]
            d = expert.width
            f = expert.mlp_dim
            gaps += [
                Unread(f"PaliGemma/llm/final_norm{suffix}/scale", (d,)),
                Unread(f"{LAYERS}/attn/q_einsum{suffix}/w", (heads, d, h), last),
                Unread(f"{LAYERS}/attn/attn_vec_einsum{suffix}/w", (heads, h, d), last),
                Unread(f"{LAYERS}/mlp{suffix}/gating_einsum", (2, d, f), last),
                Unread(f"{LAYERS}/mlp{suffix}/linear", (f, d), last),
                Unread(f"{LAYERS}/pre_ffw_norm{suffix}/scale", (d,), last),
            ]
    return gaps


def _expert_layer(config: BackboneConfig, layer: ExpertLayer, suffix: str, i: int) -> NameTable:
    kv_axes = {"two": 2, "k": config.num_kv_heads, "h": config.head_dim}
    kv = Piece(f"{LAYERS}/attn/kv_einsum{suffix}/w", "two k d h -> (two k h) d", kv_axes, i)

    def norm(target: str, source: str) -> NameTable:
        if suffix == "_1":
            return prefixed(f"{target}.dense", linear(f"{LAYERS}/{source}_1/Dense_0", layer=i))
        return {f"{target}.scale": [Piece(f"{LAYERS}/{source}{suffix}/scale", layer=i)]}

    table = norm("attention_norm", "pre_attention_norm")
    if layer.keys_only:
        return table | {"kv.weight": [kv]}
    axes = {"n": config.num_heads, "h": config.head_dim}
    q = Piece(f"{LAYERS}/attn/q_einsum{suffix}/w", "n d h -> (n h) d", axes, i)
    out = Piece(f"{LAYERS}/attn/attn_vec_einsum{suffix}/w", "n h d -> d (n h)", axes, i)
    gate_up = Piece(f"{LAYERS}/mlp{suffix}/gating_einsum", "two d f -> (two f) d", {"two": 2}, i)
    down = Piece(f"{LAYERS}/mlp{suffix}/linear", "f d -> d f", {}, i)
    table |= {
        "qkv.weight": [q, kv],
        "out.weight": [out],
        "mlp.gate_up.weight": [gate_up],
        "mlp.down.weight": [down],
    }
    return table | norm("mlp_norm", "pre_ffw_norm")


def _vision(config: BackboneConfig) -> NameTable:
    root = "PaliGemma/img"
    heads = config.vision.num_heads
    axes = {"n": heads, "h": config.vision.width // heads}
    table: NameTable = {
        "patch_embed.proj.weight": [Piece(f"{root}/embedding/kernel", "y x c d -> d c y x")],
        "patch_embed.proj.bias": [Piece(f"{root}/embedding/bias")],
        "pos_embed": [Piece(f"{root}/pos_embedding")],
        "norm.weight": [Piece(f"{root}/Transformer/encoder_norm/scale")],
        "norm.bias": [Piece(f"{root}/Transformer/encoder_norm/bias")],
    } | prefixed("head", linear(f"{root}/head"))
    for i in range(config.vision.depth):
        block = f"{root}/Transformer/encoderblock"
        attention = f"{block}/MultiHeadDotProductAttention_0"
        weights = []
        biases = []
        for name in ("query", "key", "value"):
            path = f"{attention}/{name}"
            weights.append(Piece(f"{path}/kernel", "d n h -> (n h) d", axes, i))
            biases.append(Piece(f"{path}/bias", "n h -> (n h)", axes, i))
        names: NameTable = {
            "attn.qkv.weight": weights,
            "attn.qkv.bias": biases,
            "attn.proj.weight": [Piece(f"{attention}/out/kernel", "n h d -> d (n h)", axes, i)],
            "attn.proj.bias": [Piece(f"{attention}/out/bias", layer=i)],
        }
        for n in (0, 1):
            names[f"norm{n + 1}.weight"] = [Piece(f"{block}/LayerNorm_{n}/scale", layer=i)]
            names[f"norm{n + 1}.bias"] = [Piece(f"{block}/LayerNorm_{n}/bias", layer=i)]
            names |= prefixed(f"mlp.fc{n + 1}", linear(f"{block}/MlpBlock_0/Dense_{n}", layer=i))
        table |= prefixed(f"blocks.{i}", names)
    return table
