"""From a cloud to a waypoint: the coarse look, the closer one at what it found, and the action in the world."""

from dataclasses import dataclass

import torch
from torch import Tensor

from mme_vla.backbone.sam2act.geometry import ZOOM, Cube, zoom_back
from mme_vla.backbone.sam2act.heatmaps import PointFinder
from mme_vla.backbone.sam2act.rotations import angles_of_bins
from mme_vla.memory.sam2act.keyframe_bank import BankState
from mme_vla.policy.sam2act.scene import closer_pictures, cloud_pictures
from mme_vla.policy.sam2act.two_looks import SAM2ActNetwork


@dataclass(frozen=True)
class Seen:
    """What an episode shows the network at one keyframe.

    points: [n, 3], metres. colours: [n, 3] in [0, 1]. state: [p]: gripper open, two fingers, time. language: [l, w].
    """

    points: Tensor
    colours: Tensor
    state: Tensor
    language: Tensor

    def to(self, device: torch.device) -> "Seen":
        """The same on a device."""
        return Seen(*(x.to(device) for x in (self.points, self.colours, self.state, self.language)))


@torch.no_grad()
def decide(
    network: SAM2ActNetwork, seen: Seen, remembered: BankState, cube: Cube, finder: PointFinder
) -> tuple[Tensor, BankState]:
    """The next waypoint of one episode, and what it remembers after this keyframe.

    Returns:
        The benchmark's waypoint [7]: position in metres, extrinsic roll-pitch-yaw in radians, gripper −1 (closed) or 1.
        Whether the way there may touch things, which the network tells too, the benchmark's planner does not ask.
    """
    points, colours, state, language = (x[None] for x in (seen.points, seen.colours, seen.state, seen.language))
    side, zoom = network.sizes.side, ZOOM
    look = network.look(cloud_pictures(points, colours, cube, side), state, language)
    logits, remembered = network.coarse_step(look, remembered)
    first = finder.find(logits)
    closer = network.look(closer_pictures(points, colours, cube, first, zoom, side), state, language)
    logits, tokens = network.fine_step(closer)
    point = finder.find(logits)
    found = network.heads(tokens, point)
    bins = torch.stack([found[axis].argmax(-1) for axis in "xyz"], -1)
    angles = torch.deg2rad(angles_of_bins(bins, network.sizes.rotation_bins)).float()
    grip = 2.0 * found["gripper"].argmax(-1, keepdim=True) - 1
    return torch.cat([cube.back(zoom_back(point, first, zoom)), angles, grip], -1)[0].float(), remembered


@torch.no_grad()
def watch(network: SAM2ActNetwork, seen: Seen, remembered: BankState, cube: Cube) -> BankState:
    """What an episode remembers after a frame at which nothing is decided, such as one of the conditioning video."""
    points, colours, state, language = (x[None] for x in (seen.points, seen.colours, seen.state, seen.language))
    look = network.look(cloud_pictures(points, colours, cube, network.sizes.side), state, language)
    return network.coarse_step(look, remembered)[1]
