"""LeRobot's and openpi's PyTorch checkpoints: every spelling in, both formats out."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from helpers.lerobot_pi05 import reduce_sizes
from helpers.memory_fakes import same
from mme_vla import UserError, build_policy
from mme_vla.cli.weights import convert
from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import random_batch, small_policy
from mme_vla.weights import load_weights, open_source
from mme_vla.weights.ports import to_lerobot, to_openpi

EMBEDDING = "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"
HEAD = "paligemma_with_expert.paligemma.lm_head.weight"

Tensors = dict[str, Tensor]


def renamed(*changes: tuple[str, str]) -> Callable[[Tensors], Tensors]:
    def apply(tensors: Tensors) -> Tensors:
        for pattern, new in changes:
            tensors = {re.sub(pattern, new, name): tensor for name, tensor in tensors.items()}
        return tensors

    return apply


SPELLINGS: dict[str, Callable[[Tensors], Tensors]] = {
    "as openpi's state dict": lambda tensors: tensors,
    "with model. in front": renamed((r"^", "model.")),
    "embedding only as lm_head": lambda tensors: {
        n: t for n, t in tensors.items() if n != EMBEDDING
    },
    "no lm_head at all": lambda tensors: {
        n: t for n, t in tensors.items() if not n.endswith("lm_head.weight")
    },
    "flattened vision tower": renamed((r"vision_tower\.vision_model\.", "vision_tower.")),
    "before transformers 4.52": renamed(
        (r"paligemma\.lm_head\.", "paligemma.language_model.lm_head."),
        (r"paligemma\.model\.language_model\.", "paligemma.language_model.model."),
        (r"paligemma\.model\.(vision_tower|multi_modal_projector)\.", r"paligemma.\1."),
    ),
    "before 4.52, flattened, prefixed, tied": lambda tensors: renamed(
        (r"paligemma\.lm_head\.", "paligemma.language_model.lm_head."),
        (r"paligemma\.model\.language_model\.", "paligemma.language_model.model."),
        (r"paligemma\.model\.(vision_tower|multi_modal_projector)\.", r"paligemma.\1."),
        (r"vision_tower\.vision_model\.", "vision_tower."),
        (r"^", "model."),
    )({n: t for n, t in tensors.items() if n != EMBEDDING}),
}


@pytest.fixture(scope="module")
def pi05() -> MMEPolicy:
    return small_policy("pi05")


def saved(tensors: Tensors, folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    save_file(
        {name: tensor.detach().clone() for name, tensor in tensors.items()},
        folder / "model.safetensors",
    )
    return folder


def empty_pi05(**overrides: Any) -> MMEPolicy:
    return build_policy("pi05", device="meta", **overrides)


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_every_spelling_loads_the_same_policy(
    spelling: str, pi05: MMEPolicy, tmp_path: Path
) -> None:
    folder = saved(SPELLINGS[spelling](to_openpi(pi05, pi05.state_dict())), tmp_path / "source")
    assert same(load_weights(empty_pi05(), folder), pi05)
    assert same(load_weights(empty_pi05(), folder / "model.safetensors"), pi05)


def test_format_is_recognised_from_names_and_config(pi05: MMEPolicy, tmp_path: Path) -> None:
    assert (
        open_source(saved(to_lerobot(pi05, pi05.state_dict()), tmp_path / "prefixed")).format
        == "lerobot"
    )
    bare = saved(to_openpi(pi05, pi05.state_dict()), tmp_path / "bare")
    assert open_source(bare).format == "openpi"
    (bare / "config.json").write_text('{"type": "pi05"}')
    assert open_source(bare).format == "lerobot"


def test_bfloat16_becomes_float32_masters_or_stays(pi05: MMEPolicy, tmp_path: Path) -> None:
    mixed = {
        name: tensor if "layernorm" in name else tensor.bfloat16()
        for name, tensor in to_openpi(pi05, pi05.state_dict()).items()
    }
    folder = saved(mixed, tmp_path / "mixed")
    wide, narrow = (
        load_weights(empty_pi05(), folder),
        load_weights(empty_pi05(), folder, dtype="bfloat16"),
    )
    assert {p.dtype for p in wide.parameters()} == {torch.float32}
    assert {p.dtype for p in narrow.parameters()} == {torch.bfloat16}
    for name, tensor in pi05.state_dict().items():
        assert torch.allclose(wide.state_dict()[name], tensor, rtol=2**-8, atol=0), name


def test_full_size_names_and_shapes_are_those_of_both_ports(shared: Path) -> None:
    policy = build_policy("pi05", backbone="pi05", device="meta")
    for write, listing in (
        (to_lerobot, "state_dict_lerobot_pi05.json"),
        (to_openpi, "state_dict_openpi_pytorch_pi05.json"),
    ):
        expected = json.loads((shared / "spec" / listing).read_text())["tensors"]
        exported = write(policy, policy.state_dict())
        assert {name: list(tensor.shape) for name, tensor in exported.items()} == {
            name: about["shape"] for name, about in expected.items()
        }


@torch.no_grad()
def test_lerobots_policy_loads_our_export_and_replies_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # a number that LeRobot's attention has written in
    pi05 = small_policy("pi05", backbone={"num_heads": 8})
    lerobot_module = reduce_sizes(monkeypatch, pi05.backbone.config)
    pi05.save_pretrained(tmp_path / "ours")
    convert(tmp_path / "ours", tmp_path / "lerobot", to="lerobot")
    config = lerobot_module.PreTrainedConfig.from_pretrained(tmp_path / "lerobot")
    config.device = "cpu"
    loaded = lerobot_module.PI05Policy.from_pretrained(tmp_path / "lerobot", config=config).eval()
    # it only prints what went wrong
    assert "All keys loaded successfully" in capsys.readouterr().out

    batch = random_batch(pi05)
    batch.image_mask[0, 1] = False
    noise = torch.randn(batch.actions.shape, generator=torch.Generator().manual_seed(3))
    time = torch.tensor([0.2, 0.8])
    views = list((batch.images.float() / 127.5 - 1).unbind(1))
    masks = list(batch.image_mask.unbind(1))
    loss = loaded.model.forward(
        views, masks, batch.prompt, batch.prompt_mask, batch.actions, noise, time
    ).mean()
    assert abs(float(loss - pi05(batch, noise, time)[0])) < 1e-5
    chunk = loaded.model.sample_actions(
        views, masks, batch.prompt, batch.prompt_mask, noise=noise, num_steps=10
    )
    assert (chunk - pi05.sample_actions(batch, noise)).abs().max() < 1e-4

    saved(loaded.state_dict(), tmp_path / "back")
    assert same(load_weights(empty_pi05(backbone={"num_heads": 8}), tmp_path / "back"), pi05)


def test_openpis_strict_reader_finds_one_name_of_the_tied_pair(
    pi05: MMEPolicy, tmp_path: Path
) -> None:
    pi05.save_pretrained(tmp_path / "ours")
    convert(tmp_path / "ours", tmp_path / "openpi", to="openpi", dtype="bfloat16")
    tensors = load_file(tmp_path / "openpi" / "model.safetensors")
    assert HEAD in tensors
    assert EMBEDDING not in tensors
    assert {tensor.dtype for tensor in tensors.values()} == {torch.bfloat16}
    assert json.loads((tmp_path / "openpi" / "config.json").read_text())["precision"] == "bfloat16"
    assert (tmp_path / "openpi" / "assets" / "robomme" / "norm_stats.json").is_file()


def test_all_that_does_not_fit_is_listed_together(pi05: MMEPolicy, tmp_path: Path) -> None:
    tensors = to_openpi(pi05, pi05.state_dict())
    del tensors["time_mlp_in.bias"], tensors["action_in_proj.weight"]
    tensors["action_out_proj.bias"] = torch.zeros(7)
    tensors["surprise"] = torch.zeros(1)
    with pytest.raises(UserError) as caught:
        load_weights(empty_pi05(), saved(tensors, tmp_path / "bad"))
    message = str(caught.value)
    assert re.search(r"2 missing:\s+action_in_proj.weight, time_mlp_in.bias", message)
    assert re.search(r"1 unexpected:\s+surprise", message)
    assert "action_out_proj.bias: (7,) instead of (32,)" in message


def test_pi0_is_recognised_from_pi05_by_its_tensors(pi05: MMEPolicy, tmp_path: Path) -> None:
    # The folder's name says pi05 and means nothing.
    tensors = to_openpi(pi05, pi05.state_dict())
    renamed = {
        n.replace(".dense.weight", ".weight"): t
        for n, t in tensors.items()
        if not n.endswith(".dense.bias")
    }
    with pytest.raises(UserError, match="no time-conditioned norms, as π0"):
        load_weights(empty_pi05(), saved(renamed, tmp_path / "pi05_plain"))
    with pytest.raises(UserError, match="a state projection, as π0"):
        load_weights(
            empty_pi05(),
            saved({**tensors, "state_proj.bias": torch.zeros(4)}, tmp_path / "pi05_state"),
        )


def test_a_tensor_that_is_there_twice_is_refused(pi05: MMEPolicy, tmp_path: Path) -> None:
    tensors = to_openpi(pi05, pi05.state_dict())
    tensors["model.time_mlp_in.bias"] = tensors["time_mlp_in.bias"]
    with pytest.raises(UserError, match="the same tensor twice"):
        load_weights(empty_pi05(), saved(tensors, tmp_path / "twice"))


def test_a_policy_with_memory_has_no_place_in_the_ports(pi05: MMEPolicy, tmp_path: Path) -> None:
    memory = small_policy("framesamp_expert")
    with pytest.raises(UserError, match="has a memory, whose weights would stay unset"):
        load_weights(memory, saved(to_openpi(pi05, pi05.state_dict()), tmp_path / "base"))
    with pytest.raises(UserError, match="This format has no name for"):
        to_lerobot(memory, memory.state_dict())
