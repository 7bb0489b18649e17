"""The names that PyTorch ports of π0.5 (LeRobot's, openpi's) give the backbone's tensors.

They follow transformers' modules as of 4.52, without LeRobot's leading `model.`. Matrices lie as
ours do; ours join q, k and v, and gate and up, which here are apart. An expert that integrates
memory has no names in these formats.
"""

from mme_vla.backbone.base import BackboneConfig, VisionConfig
from mme_vla.backbone.gemma import ExpertLayer
from mme_vla.backbone.layers import AdaRMSNorm
from mme_vla.backbone.pi05 import Pi05Backbone
from mme_vla.weights.tables import NameTable, Piece, Unread, prefixed

ROOT = "paligemma_with_expert"
VISION = f"{ROOT}.paligemma.model.vision_tower.vision_model"
PROJECTOR = f"{ROOT}.paligemma.model.multi_modal_projector.linear"
EXPERTS = {"vlm": f"{ROOT}.paligemma.model.language_model", "action": f"{ROOT}.gemma_expert.model"}
EMBEDDING = f"{EXPERTS['vlm']}.embed_tokens.weight"
HEAD = f"{ROOT}.paligemma.lm_head.weight"
EXPERT_HEAD = f"{ROOT}.gemma_expert.lm_head.weight"
HEADS = {
    "action_in": "action_in_proj",
    "action_out": "action_out_proj",
    "time_in": "time_mlp_in",
    "time_out": "time_mlp_out",
}

TIED = {HEAD: EMBEDDING}
"""Names that repeat another tensor: the VLM's language head is its embedding."""


def torch_names(backbone: Pi05Backbone) -> NameTable:
    """The table of vision tower, VLM, action expert and heads; names of ours are relative to the
    backbone.
    """
    table: NameTable = {"embedding.weight": [Piece(EMBEDDING)]}
    table |= prefixed("vision.vit", _vision(backbone.config.vision))
    for i, block in enumerate(backbone.transformer.layers):
        for expert, root in EXPERTS.items():
            layer: ExpertLayer = block.experts[expert]  # type: ignore[index, assignment]
            names = _expert_layer(backbone.config, layer, f"{root}.layers.{i}")
            table |= prefixed(f"transformer.layers.{i}.experts.{expert}", names)
    table |= prefixed("transformer.final_norm.dense", _affine(f"{EXPERTS['action']}.norm.dense"))
    for target, source in HEADS.items():
        table |= prefixed(target, _affine(source))
    return table


def torch_unread(backbone: Pi05Backbone) -> list[Unread]:
    """What these formats hold and no action reads: the VLM's last layer but keys and values, its
    norm, a head.
    """
    config = backbone.config
    d, f, q = config.vlm.width, config.vlm.mlp_dim, config.num_heads * config.head_dim
    last = f"{EXPERTS['vlm']}.layers.{config.depth - 1}"
    return [
        Unread(f"{last}.self_attn.q_proj.weight", (q, d)),
        Unread(f"{last}.self_attn.o_proj.weight", (d, q)),
        Unread(f"{last}.mlp.gate_proj.weight", (f, d)),
        Unread(f"{last}.mlp.up_proj.weight", (f, d)),
        Unread(f"{last}.mlp.down_proj.weight", (d, f)),
        Unread(f"{last}.post_attention_layernorm.weight", (d,)),
        Unread(f"{EXPERTS['vlm']}.norm.weight", (d,)),
        Unread(EXPERT_HEAD, (config.vocab_size, config.action.width)),
    ]


def _affine(path: str) -> NameTable:
    return {"weight": [Piece(f"{path}.weight")], "bias": [Piece(f"{path}.bias")]}


def _expert_layer(config: BackboneConfig, layer: ExpertLayer, root: str) -> NameTable:
    def rows(name: str, heads: int) -> Piece:
        return Piece(
            f"{root}.self_attn.{name}.weight",
            "(n h) d -> (n h) d",
            {"n": heads, "h": config.head_dim},
        )

    def norm(target: str, module: object, source: str) -> NameTable:
        if isinstance(module, AdaRMSNorm):
            return prefixed(f"{target}.dense", _affine(f"{root}.{source}.dense"))
        return {f"{target}.scale": [Piece(f"{root}.{source}.weight")]}

    kv = [rows("k_proj", config.num_kv_heads), rows("v_proj", config.num_kv_heads)]
    table = norm("attention_norm", layer.attention_norm, "input_layernorm")
    if layer.keys_only:
        return table | {"kv.weight": kv}
    hidden = {"f": layer.mlp.down.in_features}
    gate = Piece(f"{root}.mlp.gate_proj.weight", "f d -> f d", hidden)
    up = Piece(f"{root}.mlp.up_proj.weight", "f d -> f d", hidden)
    table |= {
        "qkv.weight": [rows("q_proj", config.num_heads), *kv],
        "out.weight": [Piece(f"{root}.self_attn.o_proj.weight")],
        "mlp.gate_up.weight": [gate, up],
        "mlp.down.weight": [Piece(f"{root}.mlp.down_proj.weight")],
    }
    return table | norm("mlp_norm", layer.mlp_norm, "post_attention_layernorm")


def _vision(config: VisionConfig) -> NameTable:
    table: NameTable = {
        "pos_embed": [Piece(f"{VISION}.embeddings.position_embedding.weight", "n d -> 1 n d")]
    }
    table |= prefixed("patch_embed.proj", _affine(f"{VISION}.embeddings.patch_embedding"))
    table |= prefixed("norm", _affine(f"{VISION}.post_layernorm"))
    table |= prefixed("head", _affine(PROJECTOR))
    for i in range(config.depth):
        root = f"{VISION}.encoder.layers.{i}"
        weights = []
        biases = []
        for name in ("q", "k", "v"):
            path = f"{root}.self_attn.{name}_proj"
            weights.append(Piece(f"{path}.weight", "e d -> e d", {"e": config.width}))
            biases.append(Piece(f"{path}.bias", "e -> e", {"e": config.width}))
        names: NameTable = {"attn.qkv.weight": weights, "attn.qkv.bias": biases}
        names |= prefixed("attn.proj", _affine(f"{root}.self_attn.out_proj"))
        for n in (1, 2):
            names |= prefixed(f"norm{n}", _affine(f"{root}.layer_norm{n}"))
            names |= prefixed(f"mlp.fc{n}", _affine(f"{root}.mlp.fc{n}"))
        table |= prefixed(f"blocks.{i}", names)
    return table
