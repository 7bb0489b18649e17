"""Augmentation moves and colours the current views as released, reproducibly."""

import colorsys
import math

import pytest
import torch
from torch import Tensor

from mme_vla.errors import UserError
from mme_vla.processing.images import (
    augment_views,
    augmentation_draws,
    crop_and_rotate,
    jitter_colours,
)

VIEWS = ("all", "colour")


def random_images(batch: int = 4, size: int = 40) -> Tensor:
    return torch.rand(batch, 2, 3, size, size, generator=torch.Generator().manual_seed(0)) * 2 - 1


def augmented(images: Tensor, seed: int = 7) -> Tensor:
    return augment_views(
        images, VIEWS, augmentation_draws(len(images), torch.Generator().manual_seed(seed))
    )


def test_same_generator_gives_same_images_and_another_seed_others() -> None:
    images = random_images()
    assert torch.equal(augmented(images), augmented(images))
    assert not torch.equal(augmented(images), augmented(images, seed=8))


def test_wrist_views_are_never_shifted_and_half_of_them_not_touched() -> None:
    images = random_images(batch=200, size=8)
    result = augmented(images)
    untouched = (result[:, 1] - images[:, 1]).abs().amax((1, 2, 3)) < 1e-6
    assert 70 <= untouched.sum() <= 130
    assert ((result[:, 0] - images[:, 0]).abs().amax((1, 2, 3)) > 1e-3).all()


def test_both_views_of_a_sample_share_their_colours() -> None:
    images = torch.full((50, 2, 3, 9, 9), 0.1)
    images[:, :, 0] = 0.4
    result = augmented(images)
    middle = result[..., 4, 4]
    assert torch.allclose(middle[:, 0], middle[:, 1], atol=1e-5)
    assert len({tuple(row) for row in middle[:, 1].mul(1e4).round().tolist()}) > 10


def test_no_rotation_and_no_offset_is_the_centre_crop() -> None:
    ramp = torch.linspace(0, 1, 40).expand(1, 1, 3, 40, 40)
    zoomed = crop_and_rotate(ramp, torch.zeros(1, 2), torch.zeros(1))
    expected = torch.linspace(-1, 1, 40) * (38 / 40) * 0.5 + 0.5
    assert torch.allclose(zoomed[0, 0, 0, 20], expected, atol=1e-6)


def test_rotation_fills_the_corners_with_black() -> None:
    bright = torch.ones(1, 1, 3, 200, 200)
    turned = crop_and_rotate(bright, torch.ones(1, 2), torch.tensor([math.radians(5)]))
    assert turned.min() == 0 and turned[..., 100, 100].min() == 1


def test_rotation_is_about_the_centre() -> None:
    dot = torch.zeros(1, 1, 3, 101, 101)
    dot[..., 50, 90] = 1
    turned = crop_and_rotate(dot, torch.zeros(1, 2), torch.tensor([math.radians(5)]))[0, 0, 0]
    row, column = divmod(int(turned.argmax()), 101)
    radius = 40 / (int(0.95 * 101) / 101)
    assert math.hypot(row - 50, column - 50) == pytest.approx(radius, abs=1)
    assert abs(math.degrees(math.atan2(row - 50, column - 50))) == pytest.approx(5, abs=1)


def one_colour(
    rgb: tuple[float, float, float], brightness: float, contrast: float, hue: float
) -> tuple[float, ...]:
    pixel = torch.tensor(rgb).reshape(1, 1, 3, 1, 1)
    result = jitter_colours(pixel, *(torch.tensor([x]) for x in (brightness, contrast, hue)))
    return tuple(result.flatten().tolist())


@pytest.mark.parametrize(
    "rgb", [(0.8, 0.2, 0.4), (0.1, 0.7, 0.3), (0.3, 0.3, 0.9), (0.5, 0.5, 0.5), (0.0, 0.0, 0.0)]
)
@pytest.mark.parametrize(
    ("brightness", "contrast", "hue"), [(0.0, 0.0, 0.0), (-0.2, 0.3, 0.08), (0.25, -0.35, -0.1)]
)
def test_colour_jitter_works_on_the_hsv_value_and_hue(
    rgb: tuple[float, float, float], brightness: float, contrast: float, hue: float
) -> None:
    h, s, v = colorsys.rgb_to_hsv(*rgb)
    v = v * (1 + brightness) if brightness < 0 else v * (1 - brightness) + brightness
    slope = math.tan((contrast + 1) * math.pi / 4)
    first = 0.25 if contrast == 0 else (slope - slope**2) / (2 * (1 - slope**2))
    if v < first:
        v = v / slope
    elif v > 1 - first:
        v = v / slope + 1 - 1 / slope
    else:
        v = slope * (v - 0.5) + 0.5
    expected = colorsys.hsv_to_rgb((h + hue) % 1, s, v)
    assert one_colour(rgb, brightness, contrast, hue) == pytest.approx(expected, abs=1e-5)


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(UserError, match="2 views but 1 cameras"):
        augment_views(random_images(), VIEWS[:1], augmentation_draws(4))
    with pytest.raises(UserError, match="square"):
        augment_views(torch.zeros(1, 2, 3, 8, 9), VIEWS, augmentation_draws(1))
