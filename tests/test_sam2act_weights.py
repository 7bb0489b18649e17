"""SAM2Act+'s sizes and names at full size, as the released checkpoints have them."""

import math

import pytest
import torch
from torch import nn

from mme_vla.backbone.sam2act.sizes import SAM2ActSizes
from mme_vla.errors import UserError
from mme_vla.policy.sam2act.network import SAM2ActNetwork
from mme_vla.policy.sam2act.stages import STAGES, select_trained
from mme_vla.weights.names.sam2act import (
    PICTURES,
    RATES,
    released_copies,
    released_names,
    released_unread,
)

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
    adapters = sum(value.numel() for name, value in network.named_parameters() if ".linear_" in name)
    assert adapters == 637_952
    assert count(network) + unread_parameters() == WHOLE


def test_each_stage_trains_as_many_parameters_as_released(network: SAM2ActNetwork) -> None:
    assert set(TRAINED) == set(STAGES)
    trained = {name: sum(value.numel() for value in select_trained(network, name)) for name in STAGES}
    # The authors count SAM2's unread parts as trained in the memory's stage.
    trained["memory"] += unread_parameters()
    assert trained == TRAINED
    select_trained(network, "first")


def test_an_unknown_stage_is_named(network: SAM2ActNetwork) -> None:
    with pytest.raises(UserError, match=r"'memroy'.*Did you mean 'memory'"):
        select_trained(network, "memroy")


def test_every_tensor_has_a_released_name_of_its_own(network: SAM2ActNetwork) -> None:
    table = released_names(network.state_dict(), network.sizes.mask_stages)
    theirs = [piece.path for pieces in table.values() for piece in pieces]
    assert len(theirs) == len(set(theirs)) == len(network.state_dict())
    held = {*theirs, *(gap.path for gap in released_unread()), RATES}
    copies = released_copies(held)
    assert len(held) + len(copies) == NAMES
    assert set(copies.values()) == {name for name in held if name.startswith(PICTURES)}
