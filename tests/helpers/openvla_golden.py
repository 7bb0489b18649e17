"""Golden cases of OpenVLA-OFT: the original's small models, built here to their sizes with their
parameters.
"""

from typing import Any

import torch
from torch import Tensor

from helpers.baselines import rule_weight
from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.extras.methods.openvla_oft.model import OpenVlaBackbone
from mme_vla.extras.methods.openvla_oft.weights import VLA, openvla_name
from mme_vla.policy.finetune import apply_finetuning
from mme_vla.policy.mme import MMEPolicy
from mme_vla.types import Batch, HistoryTokens

WRAPPER = "base_model.model."  # peft's, before every name of the model it wraps
END = 2


def parameters(golden: dict[str, Tensor], about: dict[str, Any]) -> dict[str, Tensor]:
    """All parameters of a case under their golden names: by rule, but for those that are stored."""
    seed = about["weight_seed"]
    ruled = {
        name: rule_weight(name, tuple(shape), seed) for name, shape in about["parameters"].items()
    }
    stored = {
        name.removeprefix("param/"): value
        for name, value in golden.items()
        if name.startswith("param/")
    }
    for name in ruled.keys() & stored.keys():
        torch.testing.assert_close(ruled[name], stored[name], rtol=0, atol=0)
    return ruled | stored


def golden_name(name: str) -> str:
    """The golden name of one of a policy's parameters: peft's wrapper stands before the model's
    own.
    """
    if name.startswith("memory.encoder."):
        return name.replace("memory.encoder.", "memory/")
    source = openvla_name(name)
    assert source is not None, f"{name} has no name"
    return source.replace(VLA, VLA + WRAPPER, 1)


def sections(about: dict[str, Any], values: dict[str, Tensor]) -> dict[str, Any]:
    """The policy's configuration, every dimension from the case."""
    sizes = about["sizes"]
    shapes = {name.replace(".base_layer", ""): tuple(value.shape) for name, value in values.items()}

    def tower(source: str, target: str) -> dict[str, int]:
        mlp = shapes[f"{VLA}{WRAPPER}vision_backbone.{source}.blocks.0.mlp.fc1.weight"][0]
        of = sizes[target]
        return {
            "width": of["embed_dim"],
            "depth": of["depth"],
            "num_heads": of["num_heads"],
            "mlp_dim": mlp,
        }

    llm = sizes["llm"]
    patch = shapes[f"{VLA}{WRAPPER}vision_backbone.featurizer.patch_embed.proj.weight"][-1]
    backbone = {
        "name": "openvla",
        "vision": {
            "image_size": sizes["image"],
            "patch_size": patch,
            "dino": tower("featurizer", "dino"),
            "siglip": tower("fused_featurizer", "siglip"),
        },
        "vlm": {
            "width": llm["hidden_size"],
            "mlp_dim": llm["intermediate_size"],
            "depth": llm["num_hidden_layers"],
            "num_heads": llm["num_attention_heads"],
            "norm_eps": about["rms_norm_eps"],
        },
        "vocab_size": shapes[f"{VLA}{WRAPPER}language_model.model.embed_tokens.weight"][0],
        "end_id": END,
        "action_dim": sizes["action_dim"],
        "state_dim": sizes["proprio"],
        "horizon": sizes["chunk"],
    }
    robot = ROBOMME_JOINT.with_horizon(sizes["chunk"])
    built: dict[str, Any] = {"backbone": backbone, "embodiment": robot.to_dict()}
    if "memory/project.weight" in values:
        built["memory"] = {
            "name": "framesamp",
            "budget": sizes["budget"],
            "grid": sizes["grid"],
            "position_dim": sizes["position_dim"],
            "position_hidden": sizes["position_hidden"],
        }
        built["integration"] = {"name": "context"}
    return built


def policy(golden: dict[str, Tensor], about: dict[str, Any]) -> MMEPolicy:
    """A golden model with its adapters and its parameters, read through the name table."""
    values = parameters(golden, about)
    built = MMEPolicy.from_config(sections(about, values))
    rank, scale = about["sizes"]["rank"], about["lora_scaling"]
    apply_finetuning(built, "lora", freeze_vision=False, rank=rank, alpha=scale * rank)
    state = {name: values.pop(golden_name(name)) for name in built.state_dict()}
    assert not values, f"golden parameters without a place: {sorted(values)[:5]}"
    built.load_state_dict(state)
    return built.eval()


def batch(tensors: dict[str, Tensor], about: dict[str, Any]) -> Batch:
    """The golden inputs: the words before the action ids, which the network itself replaces by
    slots.
    """
    ids, slots = tensors["in/input_ids"], about["sizes"]["chunk"] * about["sizes"]["action_dim"]
    words = tensors["in/attention_mask"].sum(1) - slots - 1  # `</s>` is the network's own too
    mask = torch.arange(int(words.max())) < words[:, None]
    views = about["sizes"]["cameras"]
    history = None
    if "in/memory_features" in tensors:
        history = HistoryTokens(
            *(tensors[f"in/memory_{name}"] for name in ("features", "positions", "mask"))
        )
    return Batch(
        images=torch.zeros(len(ids), views, 3, 1, 1),
        image_mask=torch.ones(len(ids), views, dtype=torch.bool),
        prompt=ids[:, : mask.shape[1]] * mask,
        prompt_mask=mask,
        history=history,
        actions=tensors["in/actions"],
        proprio=tensors["in/proprio"],
    )


def fused(backbone: OpenVlaBackbone, tensors: dict[str, Tensor]) -> Tensor:
    """Fused tokens [b, v, n, d] of the golden six-channel images."""
    pixels = tensors["in/pixel_values"].unflatten(1, (-1, 6))
    return backbone.vlm.vision(pixels.flatten(0, 1)).unflatten(0, pixels.shape[:2])
