"""LeRobot's own PI05 at reduced size: its size functions answer other numbers; how it computes is
untouched.
"""

from typing import Any

import pytest

from mme_vla.backbone.base import BackboneConfig


def reduce_sizes(monkeypatch: pytest.MonkeyPatch, sizes: BackboneConfig) -> Any:
    """Make LeRobot's module build at our sizes, and return it; skips where it or transformers is
    absent.
    """
    pytest.importorskip("transformers", reason="LeRobot's PI05 needs the extra 'vlm'")
    lerobot_module = pytest.importorskip("lerobot.policies.pi05.modeling_pi05")

    def sizes_of(variant: str) -> Any:
        expert = sizes.vlm if variant == "gemma_2b" else sizes.action
        shared = {
            key: getattr(sizes, key) for key in ("depth", "num_heads", "num_kv_heads", "head_dim")
        }
        return lerobot_module.GemmaConfig(width=expert.width, mlp_dim=expert.mlp_dim, **shared)

    vlm_class, expert_class = (
        lerobot_module.PaliGemmaForConditionalGenerationWithPiGemma,
        lerobot_module.PiGemmaForCausalLM,
    )

    def vlm(config: Any) -> Any:
        vision = config.vision_config
        vision.hidden_size, vision.intermediate_size = sizes.vision.width, sizes.vision.mlp_dim
        vision.num_hidden_layers, vision.num_attention_heads = (
            sizes.vision.depth,
            sizes.vision.num_heads,
        )
        vision.image_size, vision.patch_size = sizes.vision.image_size, sizes.vision.patch_size
        vision.projection_dim = config.projection_dim = sizes.vlm.width
        config.text_config.vocab_size = config._vocab_size = sizes.vocab_size
        return vlm_class(config=config)

    def expert(config: Any) -> Any:
        config.vocab_size = sizes.vocab_size
        return expert_class(config=config)

    monkeypatch.setattr(lerobot_module, "get_gemma_config", sizes_of)
    monkeypatch.setattr(lerobot_module, "PaliGemmaForConditionalGenerationWithPiGemma", vlm)
    monkeypatch.setattr(lerobot_module, "PiGemmaForCausalLM", expert)
    return lerobot_module
