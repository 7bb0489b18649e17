"""The released (JAX) names of the memories' tensors."""

import torch
from torch import Tensor, nn

from mme_vla.memory.base import Memory, PerceptualMemory
from mme_vla.memory.recurrent import RecurrentMemory
from mme_vla.memory.rmt import RMTLayer, angles
from mme_vla.memory.ttt import TTTLayer
from mme_vla.weights.tables import Derived, NameTable, Piece, Unread, linear, prefixed

ENCODER = "mem_encoder/feature_encoder"
LAYER = "mem_encoder/recur_layer"


def released_names(memory: Memory) -> NameTable:
    """The table of a memory; empty where no released checkpoint has one (a memory of one's own)."""
    if isinstance(memory, PerceptualMemory):
        return _encoder(memory, "encoder_static")
    if isinstance(memory, RecurrentMemory) and isinstance(memory.layer, TTTLayer | RMTLayer):
        table = _encoder(memory, "encoder_recur") | prefixed("output", linear("mem_encoder/proj"))
        return table | prefixed("layer", layer_names(memory.layer))
    return {}


def released_unread(memory: Memory | None) -> list[Unread]:
    """Of a recurrent memory: a layer norm that the released code has and never applies."""
    if not isinstance(memory, RecurrentMemory):
        return []
    width = (memory.output.in_features,)
    return [Unread(f"mem_encoder/pre_norm/{leaf}", width) for leaf in ("scale", "bias")]


def released_derived(memory: Memory | None) -> list[Derived]:
    """Constants that released recurrent memories store: TTT's rate constant, RMT's rotary table."""
    if not isinstance(memory, RecurrentMemory):
        return []
    layer = memory.layer
    if isinstance(layer, TTTLayer):
        constant = layer.rate_constant
        return [Derived(f"{LAYER}/ttt_base_lr_inv", lambda: torch.tensor(constant, device="cpu"))]
    if isinstance(layer, RMTLayer):
        # Twice as many positions as are used.
        positions = 2 * (memory.storage.grid**2 + len(layer.slots))
        head_dim = layer.head_dim
        return [Derived(f"{LAYER}/freqs_cis", lambda: rotary_table(positions, head_dim))]
    return []


def rotary_table(positions: int, head_dim: int) -> Tensor:
    """Return cos θ + i sin θ of every position and pair: complex64 [positions, head_dim / 2]."""
    theta = angles(positions, head_dim, torch.device("cpu"))
    return torch.polar(torch.ones_like(theta), theta)


def layer_names(layer: nn.Module, root: str = LAYER) -> NameTable:
    """The table of a recurrent layer that sits at `root` in the released tree."""

    def norm(target: str, source: str) -> NameTable:
        return {
            f"{target}.weight": [Piece(f"{root}/{source}/scale")],
            f"{target}.bias": [Piece(f"{root}/{source}/bias")],
        }

    def kernel(source: str) -> list[Piece]:
        return [Piece(f"{root}/{source}/kernel", "i o -> o i")]

    if isinstance(layer, TTTLayer):
        table: NameTable = {
            "q.weight": kernel("wq"),
            "k.weight": kernel("wk"),
            "v.weight": kernel("wv"),
            "out.weight": kernel("wo"),
        }
        for name in ("q_norm", "k_norm", "v_norm"):
            table |= norm(name, name)
        table |= norm("out_norm", "post_norm") | prefixed("rate", linear(f"{root}/lr_proj"))
        return table | {
            "weight": [Piece(f"{root}/W1")],
            "bias": [Piece(f"{root}/b1")],
            "inner_norm": [Piece(f"{root}/norm")],
        }
    assert isinstance(layer, RMTLayer)
    axes = {"k": layer.kv_heads, "h": layer.head_dim}
    k = Piece(f"{root}/k_proj/kernel", "i (k h) -> (k h) i", axes)
    v = Piece(f"{root}/v_proj/kernel", "i (k h) -> (k h) i", axes)
    table = {
        "q.weight": kernel("q_proj"),
        "out.weight": kernel("to_out"),
        "kv.weight": [k, v],
        "slots": [Piece(f"{root}/memory_state")],
    }
    return table | norm("pre_norm", "pre_norm") | norm("post_norm", "post_norm")


def _encoder(memory: Memory, project: str) -> NameTable:
    table = prefixed("encoder.project", linear(f"{ENCODER}/{project}"))
    if any(name.startswith("encoder.position.") for name, _ in memory.named_parameters()):
        table |= prefixed("encoder.position", linear(f"{ENCODER}/pos_proj"))
    return table
