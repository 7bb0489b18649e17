"""Runs in the layout of the published memory-clock checkpoints: an unknown configuration, no
position features.
"""

import shutil
from pathlib import Path

import pytest
import torch

from mme_vla import UserError
from mme_vla.cli.weights import convert
from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import random_batch, small_policy
from mme_vla.weights import load_weights, open_source
from mme_vla.weights.orbax import leaf_names, write_orbax

pytest.importorskip("tensorstore", reason="reading Orbax checkpoints needs the extra 'orbax'")
FEATURES, LAYERS = "mem_encoder/feature_encoder", "PaliGemma/llm/layers"


@pytest.fixture(scope="module")
def noclock() -> MMEPolicy:
    return small_policy("framesamp_modul", memory={"positions": "none"})


@pytest.fixture(scope="module")
def run(noclock: MMEPolicy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`noclock/29999/{params,assets}` beside a `history_config.txt`."""
    folder = tmp_path_factory.mktemp("hub")
    noclock.save_pretrained(folder / "ours")
    convert(folder / "ours", folder / "written", to="released")
    shutil.move(folder / "written" / "0", folder / "noclock" / "29999")
    assert {path.name for path in (folder / "noclock" / "29999").iterdir()} == {"params", "assets"}
    return folder / "noclock"


def name(run: Path, word: str) -> Path:
    (run / "history_config.txt").write_text(f"configs/{word}.yaml\n")
    return run


@pytest.mark.parametrize(
    ("leaves", "word", "variants"),
    [
        ([f"{LAYERS}/mem_attn/q"], "framesamp-clock", ["framesamp_modul"]),
        (["PaliGemma/llm/final_norm_mem/scale"], "my_tokendrop", ["tokendrop_expert"]),
        ([], "clock", ["framesamp_context", "tokendrop_context"]),
        (["mem_encoder/recur_layer/W1"], "clock", ["ttt_context"]),
        (["mem_encoder/recur_layer/memory_state", f"{LAYERS}/mem_attn/q"], "clock", ["rmt_modul"]),
    ],
)
def test_an_unknown_name_is_recognised_by_the_tensors(
    leaves: list[str], word: str, variants: list[str], tmp_path: Path
) -> None:
    leaves = [*leaves, f"{FEATURES}/pos_proj/kernel"]
    write_orbax({leaf: torch.zeros(1) for leaf in leaves}, tmp_path / "29999" / "params")
    source = open_source(name(tmp_path, word))
    assert source.variants == variants and not source.lacks_positions


def test_a_run_without_positions_becomes_a_memory_without_positions(
    noclock: MMEPolicy, run: Path, tmp_path: Path
) -> None:
    source = open_source(name(run, "framesamp-noclock"))
    assert source.params is not None and f"{FEATURES}/pos_proj/kernel" not in leaf_names(
        source.params
    )
    convert(run, tmp_path / "back", ["backbone=tiny"])
    back = MMEPolicy.from_pretrained(tmp_path / "back")
    assert (
        back.config["memory"]["positions"] == "none" and back.require_processor().stats is not None
    )
    loaded = load_weights(
        small_policy("framesamp_modul", seed=9, memory={"positions": "none"}), run
    )
    batch = random_batch(noclock)
    noise = torch.zeros_like(batch.actions)
    for policy in (back, loaded):
        assert torch.equal(
            policy.sample_actions(batch, noise), noclock.sample_actions(batch, noise)
        )
    with pytest.raises(UserError, match="pos_proj"):
        load_weights(small_policy("framesamp_modul"), run)


def test_tensors_that_two_variants_have_need_a_name(run: Path, tmp_path: Path) -> None:
    name(run, "noclock")
    with pytest.raises(
        UserError,
        match="framesamp_modul, tokendrop_modul: name one of these, such as model=framesamp",
    ):
        convert(run, tmp_path / "back", ["backbone=tiny"])
    with pytest.raises(
        UserError, match="says it is framesamp_modul, tokendrop_modul, but model=ttt_modul"
    ):
        convert(run, tmp_path / "back", ["backbone=tiny", "model=ttt_modul"])
    convert(run, tmp_path / "back", ["backbone=tiny", "model=framesamp_modul"])
    assert MMEPolicy.from_pretrained(tmp_path / "back").config["name"] == "framesamp_modul"
