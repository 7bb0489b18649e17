"""MemoryVLA's own files: written, and read again."""

from pathlib import Path

import pytest
import torch

from mme_vla import UserError, build_policy
from mme_vla.weights.load import load_weights
from mme_vla.weights.source import detect_format
from mme_vla.weights.writers import WRITERS, check_target


def test_a_checkpoint_is_written_by_parts_and_read_again(tmp_path: Path) -> None:
    policy, other = (build_policy("memoryvla", seed=seed) for seed in (1, 2))
    WRITERS["memoryvla"](policy, tmp_path, torch.float32, None)
    file = tmp_path / "model.pt"
    model = torch.load(file, weights_only=True)["model"]
    assert model["per_compr"]["reduce.weight"].ndim == 4
    assert "retrieval_blocks.0.q_proj.weight" in model["cog_mem_bank"]
    model["action_model"]["net.history_embedder.linear.weight"] = torch.zeros(2, 2)  # as CogACT's hold
    torch.save({"model": model}, file)
    assert detect_format(file) == "memoryvla"
    load_weights(other, file)
    for name, tensor in policy.state_dict().items():
        assert torch.equal(tensor, other.state_dict()[name]), name


def test_another_policy_has_no_place_in_it() -> None:
    with pytest.raises(UserError, match="holds MemoryVLA"):
        check_target(build_policy("pi05"), "memoryvla")
