"""Both resize paths give the released pixels, and refuse what is no image."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from mme_vla.errors import UserError
from mme_vla.processing.images import (
    as_uint8_frames,
    resize_with_pad,
    resize_with_pad_uint8,
    to_unit_range,
)


def cases(tensors: dict[str, Tensor], output: str) -> list[tuple[Tensor, Tensor]]:
    """(input, golden output) of every golden case that stores whole images."""
    names = sorted({key.split("/")[0] for key in tensors if key.endswith(f"/{output}")})
    pairs = [(tensors[f"{name}/in_uint8"], tensors[f"{name}/{output}"]) for name in names]
    assert pairs
    return pairs


def test_pillow_path_gives_the_golden_bytes(parity: Path) -> None:
    for source, golden in cases(
        load_file(parity / "unit_resize_with_pad.safetensors"), "out_pil_uint8"
    ):
        assert (
            resize_with_pad_uint8(source.numpy(), tuple(golden.shape[:2])) == golden.numpy()
        ).all()


def test_float_path_gives_the_golden_values(parity: Path) -> None:
    for source, golden in cases(
        load_file(parity / "unit_resize_with_pad.safetensors"), "out_float"
    ):
        resized = resize_with_pad(source[None], tuple(golden.shape[:2]))[0].permute(1, 2, 0)
        assert (resized - golden).abs().max() <= 1e-5


def test_both_paths_shrink_a_simulator_frame_as_released(parity: Path) -> None:
    tensors = load_file(parity / "unit_resize_with_pad.safetensors")
    what = json.loads((parity / "unit_resize_with_pad.json").read_text())["what"]
    numbers = re.search(r"repeated (\d+)x\1 .*?(\d+), rows (\d+):(\d+), cols (\d+):(\d+)", what)
    assert numbers, "the description no longer says which part of the image is stored"
    repeat, size, top, bottom, left, right = map(int, numbers.groups())
    (small,) = (value for key, value in tensors.items() if key.startswith("case0/in_"))
    frame = small.repeat_interleave(repeat, 0).repeat_interleave(repeat, 1)
    exact = resize_with_pad_uint8(frame.numpy(), size)[top:bottom, left:right]
    assert (exact == tensors["case0/out_pil_crop"].numpy()).all()
    smooth = resize_with_pad(frame[None], size)[0, :, top:bottom, left:right].permute(1, 2, 0)
    assert (smooth - tensors["case0/out_float_crop"]).abs().max() <= 1e-5


def test_images_of_the_right_size_are_left_alone() -> None:
    frames = np.random.default_rng(0).integers(0, 256, (2, 12, 12, 3), dtype=np.uint8)
    assert resize_with_pad_uint8(frames, 12) is frames
    pixels = torch.from_numpy(frames)
    assert torch.equal(resize_with_pad(pixels, 12), to_unit_range(pixels.permute(0, 3, 1, 2)))


def test_stacks_are_resized_like_single_images() -> None:
    frames = np.random.default_rng(1).integers(0, 256, (3, 2, 20, 30, 3), dtype=np.uint8)
    stacked = resize_with_pad_uint8(frames, (9, 14))
    assert stacked.shape == (3, 2, 9, 14, 3)
    assert (stacked[2, 1] == resize_with_pad_uint8(frames[2, 1], (9, 14))).all()


def test_float_and_channel_first_images_become_the_same_bytes() -> None:
    levels = np.arange(256, dtype=np.uint8).repeat(3).reshape(16, 16, 3)
    as_float = torch.from_numpy(levels).permute(2, 0, 1).float() / 255
    assert (as_uint8_frames(as_float) == levels).all()


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((4, 4), np.uint8), "Expected an image"),
        (np.zeros((4, 4, 4), np.uint8), "three channels"),
        (np.full((4, 4, 3), -0.5, np.float32), r"must lie in \[0, 1\]"),
        (np.full((4, 4, 3), np.nan, np.float32), r"must lie in \[0, 1\]"),
        (np.zeros((4, 4, 3), np.int64), "int64"),
    ],
)
def test_what_is_no_image_is_refused(image: np.ndarray, message: str) -> None:
    with pytest.raises(UserError, match=message):
        as_uint8_frames(image)


def test_resizing_refuses_other_shapes_and_types() -> None:
    with pytest.raises(UserError, match="uint8"):
        resize_with_pad_uint8(np.zeros((4, 4, 3), np.float32), 2)
    with pytest.raises(UserError, match=r"\[3, 8, 8\]"):
        resize_with_pad(torch.zeros(3, 8, 8), 4)
    with pytest.raises(UserError, match="int64"):
        resize_with_pad(torch.zeros(1, 8, 8, 3, dtype=torch.int64), 4)


@pytest.mark.parametrize("size", [(4, 1000), (1000, 4)])
def test_an_image_much_longer_than_wide_becomes_a_line(size: tuple[int, int]) -> None:
    frames = np.full((1, *size, 3), 255, np.uint8)
    resized = resize_with_pad_uint8(frames, 224)
    assert (resized > 0).any(-1).sum() == 224
    assert (resize_with_pad(torch.from_numpy(frames), 224) > 0).any(1).sum() == 224
