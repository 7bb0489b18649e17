"""SAM2Act+'s sizes and names at full size, as the released checkpoints have them, and files of that
format.
"""

import math
import re
from pathlib import Path

import pytest
import torch
from torch import nn

from helpers.memory_fakes import same
from mme_vla.errors import UserError
from mme_vla.extras.methods.sam2act.config import SAM2ActSizes
from mme_vla.extras.methods.sam2act.model import SAM2ActNetwork
from mme_vla.extras.methods.sam2act.policy import STAGES, SAM2ActPolicy
from mme_vla.extras.methods.sam2act.weights import (
    IMAGE_PREFIX,
    RATES,
    WEIGHTS,
    released_copies,
    released_names,
    released_unread,
    sam2act_adapter,
    write_sam2act,
)
from mme_vla.policy.build import build_policy
from mme_vla.weights.load import load_weights
from mme_vla.weights.source import open_source

FULL = {
    "encoder.vision": 69_106_816 + 637_952,
    "memory.attention": 2_572_032,
    "memory.encoder": 492_960,
    "coarse": 35_777_885,
    "fine": 36_726_841,
    "coarse.transformer.layers": 33_611_776,
    "coarse.decoder": 1_751_053,
    "fine.heads": 948_956,
}
WHOLE, NAMES = 149_751_000, 2_462
TRAINED = {"first": 73_142_678, "memory": 9_252_559}


@pytest.fixture(scope="module")
def network() -> SAM2ActNetwork:
    """The released sizes, as shapes alone."""
    with torch.device("meta"):
        return SAM2ActNetwork(SAM2ActSizes())


def count(module: nn.Module) -> int:
    return sum(value.numel() for value in module.parameters())


def unread_parameters() -> int:
    """What SAM2 brings along unread; one of its tensors is a constant."""
    return sum(math.prod(gap.shape) for gap in released_unread() if "gaussian" not in gap.path)


def test_every_part_has_the_released_number_of_parameters(network: SAM2ActNetwork) -> None:
    assert {name: count(network.get_submodule(name)) for name in FULL} == FULL
    adapters = sum(
        value.numel() for name, value in network.named_parameters() if ".linear_" in name
    )
    assert adapters == 637_952
    assert count(network) + unread_parameters() == WHOLE


def test_each_stage_trains_as_many_parameters_as_released(network: SAM2ActNetwork) -> None:
    assert set(TRAINED) == set(STAGES)
    parameters = {name: value.numel() for name, value in network.named_parameters()}
    trained = {
        stage: sum(count for name, count in parameters.items() if re.match(names, name))
        for stage, names in STAGES.items()
    }
    # The authors count SAM2's unread parts as trained in the memory's stage.
    trained["memory"] += unread_parameters()
    assert trained == TRAINED


def test_every_tensor_has_a_unique_released_name(network: SAM2ActNetwork) -> None:
    table = released_names(network.state_dict(), network.sizes.mask_stages)
    paths = [piece.path for pieces in table.values() for piece in pieces]
    assert len(paths) == len(set(paths)) == len(network.state_dict())
    names = {*paths, *(gap.path for gap in released_unread()), RATES}
    copies = released_copies(names)
    assert len(names) + len(copies) == NAMES
    assert set(copies.values()) == {name for name in names if name.startswith(IMAGE_PREFIX)}


# Files


@pytest.fixture(scope="module")
def policy() -> SAM2ActPolicy:
    match = build_policy("sam2act_plus")
    assert isinstance(match, SAM2ActPolicy)
    return match


@pytest.fixture(scope="module")
def file(policy: SAM2ActPolicy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("released")
    write_sam2act(policy, folder, torch.float32, None)
    return folder / WEIGHTS


def test_a_file_in_the_authors_layout_comes_back_completely(
    policy: SAM2ActPolicy, file: Path
) -> None:
    assert open_source(file).format == "sam2act_plus"
    assert same(load_weights(build_policy("sam2act_plus", seed=1), file), policy)


def test_a_policy_on_meta_is_filled_with_its_constants_too(
    policy: SAM2ActPolicy, file: Path
) -> None:
    loaded = load_weights(build_policy("sam2act_plus", device="meta"), file)
    assert isinstance(loaded, SAM2ActPolicy)
    assert not [name for name, value in loaded.state_dict().items() if value.is_meta]
    mine, other_head = policy.backbone.fine.heads, loaded.backbone.fine.heads
    assert mine is not None and other_head is not None
    assert torch.equal(mine.rates, other_head.rates)


def test_a_copy_that_is_none_and_a_tensor_that_lacks_are_named(file: Path, tmp_path: Path) -> None:
    content = torch.load(file, weights_only=True)
    copy = "mvt1.sam2.maskmem_tpos_enc"
    content["model_state"][copy] = content["model_state"][copy] + 1
    torch.save(content, tmp_path / "other.pth")
    with pytest.raises(UserError, match=r"mvt1.sam2.maskmem_tpos_enc is another tensor"):
        load_weights(build_policy("sam2act_plus", device="meta"), tmp_path / "other.pth")
    content = torch.load(file, weights_only=True)
    del content["model_state"]["mvt2.up0.1.weight"]
    torch.save(content, tmp_path / "short.pth")
    with pytest.raises(UserError, match=r"mvt2\.up0\.1\.weight"):
        load_weights(build_policy("sam2act_plus", device="meta"), tmp_path / "short.pth")


def test_other_policies_are_refused_by_name() -> None:
    with pytest.raises(UserError, match="This format holds SAM2Act"):
        sam2act_adapter(build_policy("pi05", device="meta"))
