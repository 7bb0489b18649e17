"""From a cloud to a waypoint: the coarse look, the closer one at what it found, and the action in the world."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mme_vla.backbone.sam2act.geometry import ZOOM, Cube, zoom_back
from mme_vla.backbone.sam2act.heatmaps import PointFinder
from mme_vla.backbone.sam2act.rotations import angles_of_bins
from mme_vla.memory.sam2act.bank import BankState
from mme_vla.policy.sam2act.network import SAM2ActNetwork
from mme_vla.policy.sam2act.scene import closer_pictures, cloud_pictures


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


@dataclass(frozen=True)
class Waypoint:
    """Where the tool is to go.

    point: [3], metres. angles: [3] extrinsic x-y-z in degrees. open, collide: of the gripper after it; whether the
    way there may touch things, which the benchmark's planner does not ask.
    """

    point: np.ndarray
    angles: np.ndarray
    open: bool
    collide: bool

    def action(self) -> np.ndarray:
        """The benchmark's waypoint [7] float32: position, roll-pitch-yaw in radians, gripper −1 or 1."""
        grip = 1.0 if self.open else -1.0
        return np.concatenate([self.point, np.radians(self.angles), [grip]]).astype(np.float32)


@torch.no_grad()
def decide(
    network: SAM2ActNetwork, seen: Seen, remembered: BankState, cube: Cube, finder: PointFinder
) -> tuple[Waypoint, BankState]:
    """The next waypoint of one episode, and what it remembers after this keyframe."""
    points, colours, state, language = (x[None] for x in (seen.points, seen.colours, seen.state, seen.language))
    side, zoom = network.sizes.side, ZOOM
    look = network.look(cloud_pictures(points, colours, cube, side), state, language)
    logits, remembered = network.coarse_step(look, remembered)
    first = finder.find(logits)
    closer = network.look(closer_pictures(points, colours, cube, first, zoom, side), state, language)
    logits, tokens = network.fine_step(closer)
    point = finder.find(logits)
    found = network.heads(tokens, point)
    bins = torch.stack([found[axis].argmax(-1) for axis in "xyz"], -1)[0].cpu().numpy()
    waypoint = Waypoint(
        point=cube.back(zoom_back(point, first, zoom))[0].cpu().numpy(),
        angles=angles_of_bins(bins, network.sizes.rotation_bins),
        open=bool(found["gripper"][0].argmax()),
        collide=bool(found["collision"][0].argmax()),
    )
    return waypoint, remembered


@torch.no_grad()
def watch(network: SAM2ActNetwork, seen: Seen, remembered: BankState, cube: Cube) -> BankState:
    """What an episode remembers after a frame at which nothing is decided, such as one of the conditioning video."""
    points, colours, state, language = (x[None] for x in (seen.points, seen.colours, seen.state, seen.language))
    look = network.look(cloud_pictures(points, colours, cube, network.sizes.side), state, language)
    return network.coarse_step(look, remembered)[1]
