"""OpenVLA-OFT's images and numbers: resize, crops, colours, channels and clipped quantiles, as the
original's.
"""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.baselines import baselines_folder, case
from helpers.golden import error
from mme_vla import UserError
from mme_vla.extras.methods.openvla_oft import processor as image_ops
from mme_vla.extras.methods.openvla_oft.processor import ClippedQuantiles
from mme_vla.extras.methods.prismatic import HALF, OPENVLA
from mme_vla.types import to_unit_range

FLOAT, ONE_LEVEL = 1e-5, 1e-3  # of the largest entry; share of values that may be off by one level


@pytest.fixture(scope="module")
def folder() -> Path:
    return baselines_folder("openvla_oft")


def channels_first(image: Tensor) -> Tensor:
    return image.permute(2, 0, 1)[None]


def same_levels(actual: Tensor, golden: Tensor) -> None:
    off = (actual.int() - golden.int()).abs()
    assert int(off.max()) <= 1 and float((off > 0).float().mean()) <= ONE_LEVEL


def test_openvla_oft_resize_and_centre_crop(folder: Path) -> None:
    golden, about = case(folder, "pictures")
    resized = torch.from_numpy(image_ops.lanczos(golden["raw"].numpy(), about["size"]))
    same_levels(resized, golden["resized"])
    same_levels(
        image_ops.centre_crop(channels_first(golden["resized"]))[0].permute(1, 2, 0),
        golden["center_crop"],
    )


def test_openvla_oft_resize_after_jpeg_is_near_the_originals(folder: Path) -> None:
    """Another JPEG library may differ by a few levels; without the round trip the images differ by
    more.
    """
    golden, about = case(folder, "pictures")
    raw, expected = golden["raw"].numpy(), golden["resized_after_jpeg"].numpy().astype(int)

    def off(frames: np.ndarray) -> float:
        return float(np.abs(image_ops.lanczos(frames, about["size"]).astype(int) - expected).mean())

    assert off(image_ops.jpeg_round_trip(raw)) <= min(2.0, 0.8 * off(raw))


def test_openvla_oft_augmentation_step_by_step(folder: Path) -> None:
    golden, _ = case(folder, "pictures")
    kinds = sorted({name.split("/")[0] for name in golden if name.startswith("augment")})
    assert kinds
    start = channels_first(golden["resized"])
    for kind in kinds:
        draws = golden[f"{kind}/draws"][None]
        pixels = image_ops.crop(start.float() / 255, draws[:, 0], draws[:, 1]).clamp(0, 1)
        assert error(pixels, channels_first(golden[f"{kind}/crop"])) <= FLOAT
        steps = {
            "brightness": image_ops.brighten,
            "contrast": image_ops.contrast,
            "saturation": image_ops.saturate,
            "hue": image_ops.shift_hue,
        }
        for by, (name, change) in zip(draws[0, 2:], steps.items(), strict=True):
            pixels = change(pixels, by.float().view(1, 1, 1, 1)).clamp(0, 1)
            assert error(pixels, channels_first(golden[f"{kind}/{name}"])) <= FLOAT, name
        same_levels(image_ops.augment(start, draws)[0].permute(1, 2, 0), golden[f"{kind}/final"])


def test_openvla_oft_six_channels(folder: Path) -> None:
    golden, _ = case(folder, "processor")
    pixels = (to_unit_range(channels_first(golden["processor/picture"])) + 1) / 2
    channels = torch.cat([OPENVLA.apply(pixels), HALF.apply(pixels)], 1)[0]
    expected = golden["processor/pixel_values"]
    assert error(channels, expected) <= FLOAT * float(expected.abs().max())


def statistics(folder: Path) -> tuple[ClippedQuantiles, dict[str, Tensor], np.ndarray]:
    golden, about = case(folder, "policy")
    stats = about["norm_stats"]["action"]
    mask = np.array(stats["mask"])
    statistics_ = SimpleNamespace(
        **{name: np.array(stats[name]) for name in ("q01", "q99", "min", "max")}
    )
    return ClippedQuantiles.of(statistics_, mask), golden, mask


def test_openvla_oft_actions_come_back_from_their_quantiles(folder: Path) -> None:
    quantiles, golden, mask = statistics(folder)
    assert not mask.all(), "a number that is not scaled is part of the case"
    actions = quantiles.unnormalize(golden["out/predict_normalised"].double())
    assert error(actions, golden["out/predict_actions"]) <= 1e-5 * float(
        golden["out/predict_actions"].abs().max()
    )


def test_numbers_outside_the_quantiles_are_clipped_and_those_that_never_shifted_are_zero() -> None:
    stats = SimpleNamespace(
        q01=[0.0, 5.0, 0.0], q99=[2.0, 5.0, 1.0], min=[-1.0, 5.0, 0.0], max=[3.0, 5.0, 1.0]
    )
    quantiles = ClippedQuantiles.of(stats, np.array([True, True, False]))
    x = torch.tensor([[1.0, 5.0, 7.0], [4.0, 5.0, -7.0]], dtype=torch.float64)
    expected = torch.tensor([[0.0, 0.0, 7.0], [1.0, 0.0, -7.0]], dtype=torch.float64)
    torch.testing.assert_close(quantiles.normalize(x), expected)
    torch.testing.assert_close(quantiles.unnormalize(expected[:1])[:, [0, 2]], x[:1, [0, 2]])
    with pytest.raises(UserError, match="3 numbers do not fit"):
        quantiles.normalize(torch.zeros(2, 4))
