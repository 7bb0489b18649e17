"""What both stages of training minimise, on clouds that are shifted and turned."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mme_vla.methods.sam2act.geometry import ZOOM, Cube, heatmap_loss, shift_and_rotate, to_bins
from mme_vla.methods.sam2act.model import SAM2ActNetwork
from mme_vla.methods.sam2act.processor import KeyframeBatch, cloud_images, zoomed_images
from mme_vla.types import Noise

SHIFT, ROTATION = 0.125, math.pi / 4
"""Augmentation as released: shifts to this part of the cube's sides, turns to this angle."""
_CLOSE_TO_EDGE = 1e-3  # metres that a shifted target keeps from the bounds
_BIN_OFFSETS = (-2, 2)  # how far off the bins that the heads are told may be; the upper end is left out


def augmentation_draws(count: int, keyframes: int, generator: torch.Generator) -> Noise:
    """Random numbers of `count` samples: shifts and turns in [−1, 1], and how far off told bins are."""
    return {
        "shift": 2 * torch.rand(count, keyframes, 3, generator=generator) - 1,
        "turn": 2 * torch.rand(count, keyframes, generator=generator) - 1,
        "told": torch.randint(*_BIN_OFFSETS, (count, keyframes, 3), generator=generator),
    }


@dataclass(frozen=True)
class Scenes:
    """A batch after augmentation, b·k keyframes one after the other; the points are in the world."""

    points: Tensor
    colours: Tensor
    state: Tensor
    language: Tensor
    target: Tensor
    bins: Tensor
    gripper: Tensor
    collision: Tensor


@torch.no_grad()
def augmented(
    batch: KeyframeBatch, language: Tensor, draws: Mapping[str, Tensor] | None, cube: Cube, bins: int
) -> Scenes:
    """Shift each keyframe's cloud and turn it about its target, and the target's rotation with it.

    Args:
        language: [b, l, w] tokens of the goals. draws: as `augmentation_draws` makes them; None changes nothing.
        bins: of a whole turn.
    """
    keyframes = batch.points.shape[1]
    points, target, rotation = (x.flatten(0, 1) for x in (batch.points, batch.target, batch.rotation))
    if draws is not None:
        low, high = target.new_tensor(cube.low), target.new_tensor(cube.high)
        shift = draws["shift"].flatten(0, 1).to(target) * SHIFT * (high - low)
        shifted = (target + shift).clamp(low + _CLOSE_TO_EDGE, high - _CLOSE_TO_EDGE)
        angle = draws["turn"].flatten().to(target) * ROTATION
        points = shift_and_rotate(points, target, shifted - target, angle)
        target, rotation = shifted, _turned(rotation, angle)
    return Scenes(
        points=points,
        colours=batch.colours.flatten(0, 1).to(points) / 255,
        state=batch.state.flatten(0, 1),
        language=language.repeat_interleave(keyframes, 0),
        target=cube.place(target),
        bins=to_bins(rotation, bins),
        gripper=batch.gripper.flatten(),
        collision=batch.collision.flatten(),
    )


def memory_loss(network: SAM2ActNetwork, scenes: Scenes, cube: Cube, length: int) -> dict[str, Tensor]:
    """The loss of the memory's stage: the coarse heatmaps of sequences of `length` keyframes."""
    images = cloud_images(scenes.points, scenes.colours, cube, network.sizes.side)
    logits = network.coarse_sequences(network.encode_views(images, scenes.state, scenes.language), length)
    return {"heatmap": heatmap_loss(logits, scenes.target).mean()}


def first_loss(network: SAM2ActNetwork, scenes: Scenes, cube: Cube, offsets: Tensor | None = None) -> dict[str, Tensor]:
    """The losses of the first stage, each of weight 1; single keyframes, no memory.

    The closer look stands at the true waypoint, and the heads read there.

    Args:
        offsets: [n, 3]; by how many bins the rotation that the heads are told differs from the true one.
    """
    side, centre = network.sizes.side, scenes.target
    images = cloud_images(scenes.points, scenes.colours, cube, side)
    coarse = network.coarse_alone(network.encode_views(images, scenes.state, scenes.language))
    near = zoomed_images(scenes.points, scenes.colours, cube, centre, ZOOM, side)
    fine, tokens = network.fine_step(network.encode_views(near, scenes.state, scenes.language))
    here = torch.zeros_like(centre)  # the waypoint, in the closer look's cube
    maps = torch.cat([heatmap_loss(coarse, centre), heatmap_loss(fine, here)], 1)
    noisy_bins = scenes.bins if offsets is None else (scenes.bins + offsets) % network.sizes.rotation_bins
    outputs = network.heads(tokens, here, noisy_bins)
    entropy = nn.functional.cross_entropy
    return {
        "heatmap": maps.mean(),
        **{f"rotation_{axis}": entropy(outputs[axis], scenes.bins[:, i]) for i, axis in enumerate("xyz")},
        "gripper": entropy(outputs["gripper"], scenes.gripper),
        "collision": entropy(outputs["collision"], scenes.collision),
    }


def _turned(rotation: Tensor, angle: Tensor) -> Tensor:
    """Quaternions [n, 4] (x, y, z, w) after a further turn about the vertical."""
    x, y, z, w = rotation.unbind(-1)
    sin, cos = (angle / 2).sin(), (angle / 2).cos()
    return torch.stack([cos * x - sin * y, cos * y + sin * x, cos * z + sin * w, cos * w - sin * z], -1)
