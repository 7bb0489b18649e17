"""`check_backbone` finds each of these mistakes, and names what is wrong."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from helpers import REPOSITORY
from mme_vla.backbone.base import Backbone, Injection
from mme_vla.backbone.layers import Block
from mme_vla.config.plugins import import_plugins
from mme_vla.registry import BACKBONES
from mme_vla.testing import check_backbone
from mme_vla.types import Batch

SMALL: dict[str, Any] = {
    "vision": {"image_size": 32, "patch_size": 8},
    "vlm": {"width": 16, "mlp_dim": 16},
    "depth": 1,
    "num_heads": 2,
    "vocab_size": 32,
    "horizon": 3,
    "action_dim": 4,
}


class Mistaken:
    """Members of the example backbone, to be overridden."""


class NextImageTokens(Mistaken):
    def encode_images(self, images: Tensor) -> Tensor:
        tokens = super().encode_images(images)  # type: ignore[misc]
        return torch.cat([tokens[:1] + tokens[1:2].sum(0), tokens[1:]])


class ConstantChunk(Mistaken):
    def predict(self, injection: Injection) -> Tensor:
        return 0 * super().predict(injection) + self.head.bias  # type: ignore[misc,attr-defined]


class BatchMean(Mistaken):
    def predict(self, injection: Injection) -> Tensor:
        chunk = super().predict(injection)  # type: ignore[misc]
        return chunk - chunk.mean(0) / 2


class BatchMeanInTraining(Mistaken):
    def predict(self, injection: Injection) -> Tensor:
        chunk = super().predict(injection)  # type: ignore[misc]
        return chunk - chunk.mean(0) / 2 if self.training else chunk  # type: ignore[attr-defined]


class DroppedMemory(Mistaken):
    def predict(self, injection: Injection) -> Tensor:
        blocks = [block for block in injection.blocks if block.name != "memory"]
        return super().predict(replace(injection, blocks=blocks))  # type: ignore[misc]


class NoTable(Mistaken):
    def predict(self, injection: Injection) -> Tensor:
        names = {block.name for block in injection.blocks} | {"action"}
        everything = dict.fromkeys(names, names)
        return super().predict(replace(injection, visibility=everything))  # type: ignore[misc]


class NoImageMask(Mistaken):
    def embed(self, batch: Batch) -> list[Block]:
        unmasked = replace(batch, image_mask=torch.ones_like(batch.image_mask))
        return super().embed(unmasked)  # type: ignore[misc]


class ImagesChanged(Mistaken):
    def embed(self, batch: Batch) -> list[Block]:
        batch.images.mul_(0.5)
        return super().embed(batch)  # type: ignore[misc]


class WithoutGradients(Mistaken):
    @torch.no_grad()
    def loss(self, batch: Batch, injection: Injection, noise: Mapping[str, Tensor]) -> Tensor:
        return super().loss(batch, injection, noise)  # type: ignore[misc]


class SpareLayer(Mistaken):
    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.spare = nn.Linear(2, 2)


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        (NextImageTokens, "image's tokens depend on its batch"),
        (ConstantChunk, "other images give the same chunk"),
        (BatchMean, "^beside another sample the loss differs"),
        (BatchMeanInTraining, "beside another sample the loss in training mode differs"),
        (DroppedMemory, "an injected block does not change the loss"),
        (NoTable, r"a block that injection\.visibility hides changed the loss"),
        (NoImageMask, "a view that image_mask hides changed the loss"),
        (ImagesChanged, r"embed changed batch\.images in place"),
        (WithoutGradients, "the loss has no gradient"),
        (SpareLayer, r"no gradient reaches spare\.weight, spare\.bias"),
    ],
)
def test_it_finds(mistake: type, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(REPOSITORY / "examples" / "regression")
    import_plugins(["regression"])
    kind: type[Backbone] = type("Mistaken", (mistake, BACKBONES["regression"]), {})
    monkeypatch.setitem(BACKBONES._entries, "mistaken", kind)
    with pytest.raises(AssertionError, match=message):
        check_backbone("mistaken", **SMALL)
