"""Golden cases of the released implementation: files, and policies built to their sizes with their
parameters.
"""

import json
import os
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from mme_vla.backbone.base import BackboneConfig, ExpertConfig, VisionConfig
from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.policy.mme import MMEPolicy
from mme_vla.policy.tensor_files import assign_tensors
from mme_vla.types import Batch, MemoryTokens
from mme_vla.weights.released import released_adapter

MEMORY = {"frame_sampling": "framesamp", "token_dropping": "tokendrop", "ttt": "ttt", "rmt": "rmt"}
INTEGRATION = {"context": "context", "modulation": "modulator", "expert": "expert"}


def load(folder: Path, name: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and description of one golden file; skips the test where the folder lacks it."""
    if not (folder / f"{name}.safetensors").is_file():
        pytest.skip(f"{name} is not in {folder}")
    return load_file(folder / f"{name}.safetensors"), json.loads(
        (folder / f"{name}.json").read_text()
    )


def params(tensors: dict[str, Tensor], prefix: str = "") -> dict[str, Tensor]:
    """The released parameters of a golden file, optionally under a further prefix."""
    return {
        prefix + key.removeprefix("params/"): value
        for key, value in tensors.items()
        if key.startswith("params/")
    }


def vision_config(sizes: dict[str, Any], resolution: int) -> VisionConfig:
    keys = {
        "width": "width",
        "depth": "depth",
        "mlp_dim": "mlp_dim",
        "num_heads": "num_heads",
        "patch_size": "patch",
    }
    return VisionConfig(
        image_size=resolution, **{target: sizes[source] for target, source in keys.items()}
    )


def config(about: dict[str, Any]) -> dict[str, Any]:
    """The policy configuration of a golden model, every dimension from its description."""
    vlm, action, history = (
        about["vlm_expert"],
        about["action_expert"],
        about.get("history_config") or {},
    )
    backbone = BackboneConfig(
        vision=vision_config(about["siglip"], about["image_resolution"]),
        vlm=ExpertConfig(vlm["width"], vlm["mlp_dim"]),
        action=ExpertConfig(action["width"], action["mlp_dim"]),
        **{key: vlm[key] for key in ("depth", "num_heads", "num_kv_heads", "head_dim")},
        vocab_size=about["vocab_size"],
        action_dim=about["action_dim"],
        horizon=about["action_horizon"],
    )
    sections: dict[str, Any] = {
        "backbone": {"name": "pi05", **vars(backbone)},
        "policy": {"augment": False},
        "embodiment": ROBOMME_JOINT.with_horizon(backbone.horizon).to_dict(),
    }
    if history.get("representation_type") not in ("perceptual", "recurrent"):
        return sections
    feature = history["memory_feature"]
    kind_of_memory = history[f"{history['representation_type']}_memory"]
    sections["memory"] = {
        "name": MEMORY[kind_of_memory["type"]],
        "budget": history["budget"],
        "grid": round(history["token_per_image"] ** 0.5),
        "position_dim": feature["pos"]["input_dim"],
        "position_hidden": feature["pos"]["hidden_dim"],
    }
    if history["representation_type"] == "recurrent":
        sections["memory"] |= recurrence(kind_of_memory)
    kind = INTEGRATION[history["integration_type"]]
    sections["integration"] = {"name": kind}
    if kind == "expert":
        sections["integration"] |= {
            key: about["memory_expert"][key] for key in ("width", "mlp_dim")
        }
    if kind == "modulator":
        sections["integration"] |= {
            key: about["modulator"][key] for key in ("num_heads", "num_kv_heads", "head_dim")
        }
    return sections


def recurrence(about: dict[str, Any]) -> dict[str, Any]:
    """The options of a golden recurrent memory."""
    options = {
        "hidden": about["hidden_dim"],
        "max_steps": about["max_recur_steps"],
        "max_video": about["max_pretraj_steps"],
        "chunk": about["max_recur_steps"] // about["remat_n_mini_batches"],
    }
    names = {
        "rmt": {"heads": "num_attn_heads", "kv_heads": "num_kv_heads"},
        "ttt": {
            "heads": "num_ttt_heads",
            "base_rate": "base_lr",
            "max_rate": "max_lr",
            "max_grad_norm": "max_grad_norm",
        },
    }[about["type"]]
    return options | {
        target: about[f"{about['type']}_config"][source] for target, source in names.items()
    }


def from_released(policy: MMEPolicy, tree: dict[str, Tensor]) -> MMEPolicy:
    """Fill a policy from a released tree."""
    tensors = released_adapter(policy).translate(tree, policy.state_dict(), "the released tree")
    assign_tensors(policy, tensors, "the released tree")
    return policy


def policy(tensors: dict[str, Tensor], about: dict[str, Any]) -> MMEPolicy:
    """A golden model, its parameters read through the adapter for released trees."""
    sections = config(about)
    built = MMEPolicy.from_config(sections)
    history = about.get("history_config") or {}
    if built.memory is not None:
        # The golden features are narrower than the tower's tokens: the memory's width of a vision
        # token is its own.
        from mme_vla.registry import MEMORIES

        options = {k: v for k, v in sections["memory"].items() if k != "name"}
        built.memory = MEMORIES[sections["memory"]["name"]](
            d_vision=history["memory_feature"]["img"]["input_dim"],
            width=built.integration.memory_width,
            **options,
        )
    return from_released(built, params(tensors)).eval()


def batch(tensors: dict[str, Tensor]) -> Batch:
    """The golden inputs as a batch (without history: golden memories come with ready-made position
    features).
    """
    cameras = ("base_0_rgb", "left_wrist_0_rgb")
    prompt = (
        "symbolic_tokenized_prompt"
        if "in/symbolic_tokenized_prompt" in tensors
        else "tokenized_prompt"
    )
    return Batch(
        images=torch.stack([tensors[f"in/image/{c}"] for c in cameras], 1).permute(0, 1, 4, 2, 3),
        image_mask=torch.stack([tensors[f"in/image_mask/{c}"] for c in cameras], 1),
        prompt=tensors[f"in/{prompt}"].long(),
        prompt_mask=tensors[f"in/{prompt}_mask"],
        actions=tensors["in/actions"],
    )


def memory_tokens(policy: MMEPolicy, tensors: dict[str, Tensor]) -> MemoryTokens | None:
    """Encode the golden memory inputs."""
    if policy.memory is None:
        return None
    memory: Any = policy.memory
    encoder = memory.encoder
    if "in/recur_mask" in tensors:
        features, positions = (
            tensors[f"in/recur_{name}"].flatten(2, 3) for name in ("image_emb", "pos_emb")
        )
        return memory.run(encoder.encode(features, positions), tensors["in/recur_mask"])
    tokens = encoder.encode(tensors["in/static_image_emb"], tensors["in/static_pos_emb"])
    return MemoryTokens(tokens, tensors["in/static_mask"])


ERRORS: dict[str, float] = {}
"""Largest error seen per test, for the table in docs/evidence/parity.md (`MME_VLA_PARITY_TABLE=1`,
see conftest.py).
"""


def error(actual: Tensor, golden: Tensor) -> float:
    """Largest absolute difference; also kept under the running test's name."""
    assert actual.shape == golden.shape, (actual.shape, golden.shape)
    worst = float((actual.double() - golden.double()).abs().max())
    test = os.environ.get("PYTEST_CURRENT_TEST", "").rsplit(" ", 1)[0].rsplit("::", 1)[-1]
    ERRORS[test] = max(worst, ERRORS.get(test, 0.0))
    return worst
