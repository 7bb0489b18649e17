"""OpenVLA-OFT as a policy: its five compositions learn and act, and refuse what they cannot do."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from mme_vla import UserError, build_policy
from mme_vla.extras.methods.openvla_oft.policy import OpenVlaPolicy
from mme_vla.extras.methods.openvla_oft.processor import OpenVlaProcessor
from mme_vla.extras.methods.prismatic import Angles
from mme_vla.testing import check_backbone
from mme_vla.testing.small import random_batch, unit_stats
from mme_vla.types import Batch

MODELS = ["openvla_oft", *(f"openvla_oft_{kind}" for kind in (
    "simplesg", "groundsg", "tokendrop_context", "framesamp_context"))]  # fmt: skip
TOWER = {"width": 8, "depth": 2, "mlp_dim": 16, "num_heads": 2}
SMALL = {
    "vision": {"image_size": 32, "patch_size": 2, "dino": TOWER, "siglip": TOWER},
    "vlm": {"width": 32, "mlp_dim": 64, "depth": 2, "num_heads": 2},
    "vocab_size": 128,
    "horizon": 5,
    "action_dim": 8,
    "state_dim": 0,
}


def tiny(name: str = "openvla_oft") -> OpenVlaPolicy:
    policy = build_policy(name)
    assert isinstance(policy, OpenVlaPolicy)
    policy.require_processor().stats = unit_stats(policy.embodiment)
    return policy


def batch_for(policy: OpenVlaPolicy) -> Batch:
    batch = random_batch(policy, valid=64)
    return replace(
        batch, proprio=torch.rand(len(batch.prompt), policy.embodiment.state.width) * 2 - 1
    )


def test_it_keeps_a_backbones_contract() -> None:
    # of the towers the last but one layer is read
    check_backbone("openvla", r"vlm\.(vision\.(dino|siglip)\.|language\.lm_head)", **SMALL)


def test_its_language_model_rotates_by_the_angles_of_transformers() -> None:
    import transformers
    from transformers.models.llama.modeling_llama import LlamaRotaryEmbedding

    sizes = transformers.LlamaConfig(hidden_size=16, num_attention_heads=2)  # type: ignore[call-arg]
    x, positions = torch.zeros(1, 3, 16), torch.tensor([[0, 1, 7]])
    expected = LlamaRotaryEmbedding(sizes)(x, positions)
    torch.testing.assert_close(Angles(8)(x, positions), expected)


@pytest.mark.parametrize("name", MODELS)
def test_every_composition_learns_and_acts(name: str) -> None:
    policy = tiny(name)
    batch = batch_for(policy)
    loss, _ = policy(batch)
    loss.backward()
    if policy.memory is not None:
        gradient = policy.memory.get_parameter("encoder.project.weight").grad
        assert gradient is not None and gradient.abs().sum() > 0
    episode = policy.start_episode("Press the button.")
    episode.subgoal = "press the red button at <10, 20>"
    frames = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8)
    episode.observe({"front": frames, "wrist": frames}, np.zeros((3, 8), np.float32))
    chunk = policy.act(episode)
    assert chunk.shape == (20, 8) and np.isfinite(chunk).all()
    np.testing.assert_array_equal(policy.act(episode), chunk)


def test_the_state_and_the_memory_reach_the_actions_and_padding_does_not() -> None:
    policy = tiny("openvla_oft_framesamp_context")
    batch = batch_for(policy)
    assert batch.proprio is not None and batch.history is not None
    actions = policy.sample_actions(batch)

    def off(other: Batch) -> Tensor:
        return (policy.sample_actions(other) - actions).abs().max()

    assert off(replace(batch, proprio=-batch.proprio)) > 1e-4
    features, mask = batch.history.features, batch.history.mask[..., None]
    assert off(replace(batch, history=replace(batch.history, features=features * 0.5))) > 1e-6
    assert (
        off(replace(batch, history=replace(batch.history, features=features + 7.0 * ~mask))) < 1e-5
    )
    longer = torch.nn.functional.pad(batch.prompt, (0, 5), value=3)
    assert (
        off(
            replace(
                batch, prompt=longer, prompt_mask=torch.nn.functional.pad(batch.prompt_mask, (0, 5))
            )
        )
        < 1e-5
    )


def test_prompts_ask_in_lower_case_name_the_subgoal_and_end_in_the_opening_piece() -> None:
    for name, subgoal, expected in (
        ("openvla_oft", None, "in: what action should the robot take to press the button.? out:"),
        (
            "openvla_oft_simplesg",
            "Go Left",
            "take to press the button; current subgoal: go left? out:",
        ),
    ):
        processor = tiny(name).require_processor()
        assert isinstance(processor, OpenVlaProcessor)
        ids, mask = processor.prompt("Press the Button.", subgoal=subgoal)
        words = processor.tokenizer.decode(ids[mask].tolist()).lower().replace("\n", " ")
        assert " ".join(words.split()).endswith(expected.removeprefix("in: ")), words
        assert int(ids[mask][-1]) == processor.tokenizer.piece("▁")


def test_what_this_backbone_cannot_do_is_refused_in_words() -> None:
    with pytest.raises(UserError, match="every token sees every other"):
        build_policy("openvla_oft_framesamp_context", integration={"prompt_sees_memory": False})
    with pytest.raises(UserError, match="'openvla' has no place for"):
        build_policy(
            "framesamp_modul", backbone="openvla_tiny", embodiment="robomme_joint_absolute"
        )
    with pytest.raises(UserError, match="as wide as the robot's"):
        build_policy("openvla_oft", backbone={"action_dim": 32})
