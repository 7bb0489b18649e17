"""Released weights of SAM2Act+: the names of their tensors, and reading and writing them."""

import itertools
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import torch
from torch import Tensor

from mme_vla.errors import require
from mme_vla.extras.methods.sam2act.model import code_rates
from mme_vla.extras.methods.sam2act.policy import SAM2ActPolicy
from mme_vla.policy.base import Policy
from mme_vla.policy.tensor_files import cast
from mme_vla.processing.normalise import NormStats
from mme_vla.weights.tables import (
    Adapter,
    Derived,
    NameTable,
    Piece,
    Unread,
    prefixed,
    wrong_policy,
)

_Rule = tuple[str, str | Callable[[re.Match[str]], str]]
# Ours → theirs, where a name begins so; the first that matches decides.
_PLACES: list[_Rule] = [
    (r"encoder\.vision\.backbone\.", "sam2.image_encoder.trunk."),
    (r"encoder\.vision\.neck\.convs\.(\d+)\.", r"sam2.image_encoder.neck.convs.\1.conv."),
    (r"encoder\.fine\.", "sam2.sam_mask_decoder.conv_s0."),
    (r"encoder\.middle\.", "sam2.sam_mask_decoder.conv_s1."),
    (r"memory\.ages$", "sam2.maskmem_tpos_enc"),
    (r"memory\.encoder\.mask\.convolutions\.(\d+)\.", lambda m: _mask(3 * int(m[1]))),
    (r"memory\.encoder\.mask\.norms\.(\d+)\.", lambda m: _mask(3 * int(m[1]) + 1)),
    (r"memory\.encoder\.tokens\.", "sam2.memory_encoder.pix_feat_proj."),
    (r"memory\.encoder\.fuser\.", "sam2.memory_encoder.fuser.layers."),
    (r"memory\.encoder\.out\.", "sam2.memory_encoder.out_proj."),
    (r"memory\.attention\.", "sam2.memory_attention."),
    (r"coarse\.", "mvt1."),
    (r"fine\.", "mvt2."),
]
_PARTS: list[_Rule] = [
    (r"^(sam2\.image_encoder\.trunk\.patch_embed)\.projection\.", r"\1.proj."),
    (r"^(sam2\.image_encoder\..*)\.layer_norm([12])\.", r"\1.norm\2."),
    (r"\.mlp\.proj_in\.", ".mlp.layers.0."),
    (r"\.mlp\.proj_out\.", ".mlp.layers.1."),
    (r"(fuser\.layers\.\d+)\.depthwise\.", r"\1.dwconv."),
    (r"(fuser\.layers\.\d+)\.into\.", r"\1.pwconv1."),
    (r"(fuser\.layers\.\d+)\.back\.", r"\1.pwconv2."),
    (r"(fuser\.layers\.\d+)\.scale$", r"\1.gamma"),
    (r"^(sam2\.memory_attention\.layers\.\d+)\.self_norm\.", r"\1.norm1."),
    (r"^(sam2\.memory_attention\.layers\.\d+)\.memory_norm\.", r"\1.norm2."),
    (r"^(sam2\.memory_attention\.layers\.\d+)\.feed_norm\.", r"\1.norm3."),
    (r"^(sam2\.memory_attention\.layers\.\d+)\.into\.", r"\1.linear1."),
    (r"^(sam2\.memory_attention\.layers\.\d+)\.back\.", r"\1.linear2."),
    (r"\.self_attention\.", ".self_attn."),
    (r"\.memory_attention\.(queries|keys|values|out)\.", r".cross_attn_image.\1."),
    (r"\.(q)ueries\.|\.(k)eys\.|\.(v)alues\.", lambda m: f".{m[1] or m[2] or m[3]}_proj."),
    (r"(_attn|cross_attn_image)\.out\.", r"\1.out_proj."),
    (r"^(mvt\d)\.transformer\.positions$", r"\1.pos_encoding"),
    (r"^(mvt\d)\.transformer\.state\.layer\.", r"\1.proprio_preprocess.linear."),
    (r"^(mvt\d)\.transformer\.state\.norm\.", r"\1.proprio_preprocess.norm."),
    (r"^(mvt\d)\.transformer\.patches\.layer\.", r"\1.patchify.conv2d."),
    (r"^(mvt\d)\.transformer\.patches\.norm\.", r"\1.patchify.norm."),
    (r"^(mvt\d)\.transformer\.language\.layer\.", r"\1.lang_preprocess.linear."),
    (r"^(mvt\d)\.transformer\.language\.norm\.", r"\1.lang_preprocess.norm."),
    (r"^(mvt\d)\.transformer\.sam\.", r"\1.fusion.conv2d."),
    (r"^(mvt\d)\.transformer\.unused_sam\.", r"\1.fusion_up.conv2d."),
    (r"^(mvt\d)\.transformer\.wide\.", r"\1.fc_bef_attn.linear."),
    (r"^(mvt\d)\.transformer\.narrow\.", r"\1.fc_aft_attn.linear."),
    (r"^(mvt\d)\.transformer\.layers\.(\d+)\.attention_norm\.", r"\1.layers.\2.0.norm."),
    (r"^(mvt\d)\.transformer\.layers\.(\d+)\.attention\.", r"\1.layers.\2.0.fn."),
    (r"^(mvt\d)\.transformer\.layers\.(\d+)\.feed_norm\.", r"\1.layers.\2.1.norm."),
    (r"^(mvt\d)\.transformer\.layers\.(\d+)\.feed\.into\.", r"\1.layers.\2.1.fn.net.0."),
    (r"^(mvt\d)\.transformer\.layers\.(\d+)\.feed\.out\.", r"\1.layers.\2.1.fn.net.2."),
    (r"^(mvt\d)\.decoder\.first\.", r"\1.up0.0."),
    (r"^(mvt\d)\.decoder\.first_norm\.", r"\1.up0.1."),
    (r"^(mvt\d)\.decoder\.second\.", r"\1.up0.3."),
    (r"^(mvt\d)\.decoder\.second_norm\.", r"\1.up0.4."),
    (r"^(mvt\d)\.decoder\.last\.", r"\1.up0.7."),
    (r"^(mvt\d)\.heads\.gripper\.", r"\1.feat_fc_ex_rot."),
    (r"^(mvt\d)\.heads\.norm\.", r"\1.feat_fc_init_bn."),
    (r"^(mvt\d)\.heads\.([xyz])\.", r"\1.feat_fc_\2."),
]
_AGES = "k 1 1 m -> k m"
BRANCHES = ("mvt1", "mvt2")
RATES = "mvt2.feat_fc_pe.div_term"
IMAGE_PREFIX = "sam2."
"""SAM2's tensors begin so; a checkpoint holds them twice more, once below each branch."""


def released_names(targets: Iterable[str], mask_stages: int) -> NameTable:
    """The released code's name of each of the network's tensors; masks are halved `mask_stages`
    times.
    """
    places = [(r"memory\.encoder\.mask\.out\.", _mask(3 * mask_stages)), *_PLACES]
    table: NameTable = {}
    for name in targets:
        # The first place that fits, then the names of its parts
        released = name
        for pattern, replacement in places:
            released, count = re.subn(f"^{pattern}", replacement, released, count=1)
            if count:
                break
        for pattern, replacement in _PARTS:
            released = re.sub(pattern, replacement, released)
        table[name] = [Piece(released, _AGES if name.endswith("memory.ages") else "")]
    return table


def released_copies(names: Iterable[str]) -> dict[str, str]:
    """Copy → original: the branches' own copies of every tensor of SAM2's."""
    copies = {}
    for name in names:
        if name.startswith(IMAGE_PREFIX):
            for branch in BRANCHES:
                copies[f"{branch}.{name}"] = name
    return copies


def released_unread(width: int = 256) -> list[Unread]:
    """What SAM2 brings along and nothing here reads: prompt encoder, mask decoder, object pointers.

    Args:
        width: of SAM2's own tokens.
    """
    half, small, eighth = width // 2, width // 4, width // 8
    tokens = 4  # of the mask decoder
    shapes: dict[str, tuple[int, ...]] = {
        "no_mem_embed": (1, 1, width),
        "no_mem_pos_enc": (1, 1, width),
        "no_obj_ptr": (1, width),
        **_layer("mask_downsample", 1, 1, 4, 4),
        **_layers("obj_ptr_proj.layers", [width] * 4),
        **_layer("obj_ptr_tpos_proj", small, width),
    }
    prompt = "sam_prompt_encoder"
    shapes[f"{prompt}.pe_layer.positional_encoding_gaussian_matrix"] = (2, half)
    embeddings = [f"point_embeddings.{i}" for i in range(4)]
    for name in (*embeddings, "not_a_point_embed", "no_mask_embed"):
        shapes[f"{prompt}.{name}.weight"] = (1, width)
    for step, (out, into, side) in {0: (4, 1, 2), 3: (16, 4, 2), 6: (width, 16, 1)}.items():
        shapes |= _layer(f"{prompt}.mask_downscaling.{step}", out, into, side, side)
    for step, channels in {1: 4, 4: 16}.items():
        shapes |= _layer(f"{prompt}.mask_downscaling.{step}", channels)
    decoder = "sam_mask_decoder"
    for name, count in {"iou_token": 1, "obj_score_token": 1, "mask_tokens": tokens}.items():
        shapes[f"{decoder}.{name}.weight"] = (count, width)
    for layer in range(2):
        place = f"{decoder}.transformer.layers.{layer}"
        shapes |= _attention(f"{place}.self_attn", width, width)
        for name in ("cross_attn_token_to_image", "cross_attn_image_to_token"):
            shapes |= _attention(f"{place}.{name}", width, half)
        shapes |= _layers(f"{place}.mlp.layers", [width, 8 * width, width])
        for number in range(1, 5):
            shapes |= _layer(f"{place}.norm{number}", width)
    shapes |= _attention(f"{decoder}.transformer.final_attn_token_to_image", width, half)
    shapes |= _layer(f"{decoder}.transformer.norm_final_attn", width)
    for step, (into, out) in {0: (width, small), 3: (small, eighth)}.items():
        name = f"{decoder}.output_upscaling.{step}"
        shapes |= {f"{name}.weight": (into, out, 2, 2), f"{name}.bias": (out,)}
    shapes |= _layer(f"{decoder}.output_upscaling.1", small)
    for token in range(tokens):
        name = f"{decoder}.output_hypernetworks_mlps.{token}.layers"
        shapes |= _layers(name, [width, width, width, eighth])
    shapes |= _layers(f"{decoder}.iou_prediction_head.layers", [width, width, width, tokens])
    shapes |= _layers(f"{decoder}.pred_obj_score_head.layers", [width, width, width, 1])
    return [Unread(f"{IMAGE_PREFIX}{name}", shape) for name, shape in shapes.items()]


def _layer(name: str, out: int, *inputs: int) -> dict[str, tuple[int, ...]]:
    """Shapes of a linear layer, a convolution, or (without inputs) a norm."""
    return {f"{name}.weight": (out, *inputs), f"{name}.bias": (out,)}


def _layers(name: str, widths: list[int]) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    for i, (into, out) in enumerate(itertools.pairwise(widths)):
        shapes |= _layer(f"{name}.{i}", out, into)
    return shapes


def _attention(name: str, width: int, inner: int) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    for part in "qkv":
        shapes |= _layer(f"{name}.{part}_proj", inner, width)
    return shapes | _layer(f"{name}.out_proj", width, inner)


def _mask(place: int) -> str:
    return f"sam2.memory_encoder.mask_downsampler.encoder.{place}."


WEIGHTS = "model_plus_last.pth"
_WRAPPED = "module."


def is_sam2act(names: Iterable[str]) -> bool:
    """Whether tensors are named as in the authors' checkpoints, in whatever wrapping."""
    unwrapped = {name.removeprefix(_WRAPPED) for name in names}
    return {"mvt1.pos_encoding", "mvt2.pos_encoding"} <= unwrapped


def unwrap_sam2act_names(tensors: Mapping[str, Tensor], source: str) -> dict[str, Tensor]:
    """Tensors by their names without wrapping, each copy of SAM2's compared with the original."""
    renamed = {name.removeprefix(_WRAPPED): tensor for name, tensor in tensors.items()}
    for copy, original in released_copies(renamed).items():
        require(
            not (copy in renamed and not torch.equal(renamed[copy], renamed[original])),
            f"{source}: {copy} is another tensor than {original}, of which it should be a copy.",
        )
    return renamed


def sam2act_adapter(policy: Policy) -> Adapter:
    """The authors' names of this policy's tensors."""
    if not isinstance(policy, SAM2ActPolicy):
        raise wrong_policy(policy, "SAM2Act+", "model=sam2act_plus")
    sizes = policy.backbone.sizes
    table = released_names(policy.backbone.state_dict(), sizes.mask_stages)
    unread = released_unread(sizes.encoder.neck)
    originals = [gap.path for gap in unread]
    for pieces in table.values():
        originals += [piece.path for piece in pieces]
    rates = Derived(RATES, lambda: code_rates(sizes.feature)[None])  # of the rotation bins' codes
    return Adapter(prefixed("backbone", table), unread, released_copies(originals), [rates])


def write_sam2act(
    policy: Policy, folder: Path, dtype: torch.dtype, stats: NormStats | None
) -> None:
    """`model_plus_last.pth` as the authors' training writes it, but for the optimizer's state."""
    released = sam2act_adapter(policy).export(policy.state_dict())
    model = {name: cast(tensor.detach(), dtype).cpu() for name, tensor in released.items()}
    torch.save(
        {"epoch": 0, "model_state": model, "optimizer_state": {}, "lr_sched_state": {}},
        folder / WEIGHTS,
    )
