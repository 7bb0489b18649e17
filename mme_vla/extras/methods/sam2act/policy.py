"""`SAM2ActPolicy`: from coloured points to the next waypoint, with a memory of keyframes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.backbone.base import FineTuneSpec
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import check_choice, require
from mme_vla.extras.methods.network import processor_for
from mme_vla.extras.methods.sam2act.config import SAM2ActSizes
from mme_vla.extras.methods.sam2act.episode import KeyframeEpisode, SceneInputs, decide, watch
from mme_vla.extras.methods.sam2act.geometry import (
    ZOOM,
    Cube,
    PointFinder,
    heatmap_loss,
    shift_and_rotate,
    to_bins,
)
from mme_vla.extras.methods.sam2act.model import SAM2ActNetwork
from mme_vla.extras.methods.sam2act.processor import (
    NAME,
    KeyframeBatch,
    SAM2ActProcessor,
    cloud_images,
    zoomed_images,
)
from mme_vla.extras.methods.sam2act.sam2 import BankState
from mme_vla.policy.base import PolicyInfo
from mme_vla.policy.network import NetworkPolicy
from mme_vla.policy.saving import policy_options
from mme_vla.policy.sections import PolicySections
from mme_vla.registry import POLICIES
from mme_vla.speed import Recompute, Recomputes
from mme_vla.speed.sharding import ShardGroup, stacked_layers
from mme_vla.types import Noise, map_noise

if TYPE_CHECKING:
    from mme_vla.policy.episode import Episode
    from mme_vla.processing.base import PolicyProcessor


SHIFT, ROTATION = 0.125, math.pi / 4
"""Augmentation as released: shifts to this part of the cube's sides, turns to this angle."""
_CLOSE_TO_EDGE = 1e-3  # metres that a shifted target keeps from the bounds
_BIN_OFFSETS = (-2, 2)  # how far off the bins given to the heads; the upper end is left out


@dataclass(frozen=True)
class Scenes:
    """A batch after augmentation, b·k keyframes one after the other; the points are in
    the world.
    """

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
    batch: KeyframeBatch,
    language: Tensor,
    noise: Mapping[str, Tensor] | None,
    cube: Cube,
    bins: int,
) -> Scenes:
    """Shift each keyframe's cloud and turn it about its target, and the target's rotation with it.

    Args:
        language: [b, l, w] tokens of the goals.
        noise: as `SAM2ActPolicy.training_noise` makes them; None changes nothing.
        bins: of a whole turn.
    """
    keyframes = batch.points.shape[1]
    points = batch.points.flatten(0, 1)
    target = batch.target.flatten(0, 1)
    rotation = batch.rotation.flatten(0, 1)
    if noise is not None:
        low, high = target.new_tensor(cube.low), target.new_tensor(cube.high)
        shift = noise["shift"].flatten(0, 1).to(target) * SHIFT * (high - low)
        shifted = (target + shift).clamp(low + _CLOSE_TO_EDGE, high - _CLOSE_TO_EDGE)
        angle = noise["turn"].flatten().to(target) * ROTATION
        points = shift_and_rotate(points, target, shifted - target, angle)
        target = shifted
        # Quaternions after a further turn about the vertical.
        x, y, z, w = rotation.unbind(-1)
        sin, cos = (angle / 2).sin(), (angle / 2).cos()
        turned = [cos * x - sin * y, cos * y + sin * x, cos * z + sin * w, cos * w - sin * z]
        rotation = torch.stack(turned, -1)
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


def first_loss(
    network: SAM2ActNetwork, scenes: Scenes, cube: Cube, offsets: Tensor | None = None
) -> dict[str, Tensor]:
    """The losses of the first stage, each of weight 1; single keyframes, no memory.

    The closer look stands at the true waypoint, and the heads read there.

    Args:
        offsets: [n, 3]; by how many bins the rotation given to the heads differs from the true one.
    """
    side, centre = network.sizes.side, scenes.target
    images = cloud_images(scenes.points, scenes.colours, cube, side)
    coarse = network.coarse_alone(network.encode_views(images, scenes.state, scenes.language))
    near = zoomed_images(scenes.points, scenes.colours, cube, centre, ZOOM, side)
    fine, tokens = network.fine_step(network.encode_views(near, scenes.state, scenes.language))
    here = torch.zeros_like(centre)  # the waypoint, in the closer look's cube
    maps = torch.cat([heatmap_loss(coarse, centre), heatmap_loss(fine, here)], 1)
    bins = scenes.bins
    if offsets is not None:
        bins = (bins + offsets) % network.sizes.rotation_bins
    outputs = network.heads(tokens, here, bins)
    entropy = nn.functional.cross_entropy
    return {
        "heatmap": maps.mean(),
        "rotation_x": entropy(outputs["x"], scenes.bins[:, 0]),
        "rotation_y": entropy(outputs["y"], scenes.bins[:, 1]),
        "rotation_z": entropy(outputs["z"], scenes.bins[:, 2]),
        "gripper": entropy(outputs["gripper"], scenes.gripper),
        "collision": entropy(outputs["collision"], scenes.collision),
    }


STAGES = {
    "first": r"coarse\.|fine\.|encoder\.vision\..*\.linear_[ab]_[qv]\.",
    "memory": r"memory\.|encoder\.fine\.|encoder\.middle\.|coarse\.decoder\.",
}
"""Stage → pattern of the parameters that learn in it, as the authors froze the others."""


WIDTH = 7
"""Numbers of a waypoint: position, roll-pitch-yaw, gripper."""


@POLICIES.register(NAME)
class SAM2ActPolicy(NetworkPolicy, Recomputes):
    """SAM2Act+ (RoboMME's fine-tuned model): one waypoint at a time, which the benchmark's planner
    moves to.
    """

    processor: SAM2ActProcessor | None
    memory = None  # its memory stands inside the network, between transformer and decoder

    def __init__(
        self,
        backbone: SAM2ActNetwork,
        processor: SAM2ActProcessor | None = None,
        config: Mapping[str, Any] | None = None,
        *,
        stage: str = "memory",
        **options: Any,
    ) -> None:
        """Put the parts together.

        Args:
            stage: which of the authors' two stages trains: `first` or `memory`.
            processor, config, options: of `NetworkPolicy`. The authors train in float16.
        """
        super().__init__(processor, config, **options)
        check_choice("policy.stage", stage, STAGES)
        self.backbone, self.stage = backbone, stage
        self.horizon, self.action_dim = 1, WIDTH
        sizes = backbone.sizes
        processor_sizes = {"text.width": sizes.language, "text.words": sizes.words}
        self.info = replace(self._info, processor_sizes=processor_sizes)
        # Single keyframes first, then one more than can be remembered.
        self.keyframes = 1 if stage == "first" else backbone.sizes.remembered + 1

    @classmethod
    def from_config(
        cls,
        config: Mapping[str, Any],
        processor: "PolicyProcessor | None" = None,
        *,
        fresh_backbone: bool = True,
    ) -> Self:
        sections = PolicySections.of(config)
        sizes, robot = SAM2ActSizes.from_dict(sections.backbone), embodiment_of(config)
        require(
            robot.action.width == WIDTH
            and robot.action.frames is None
            and robot.action.horizon == 1,
            f"SAM2Act+ predicts one planned motion of {WIDTH} numbers; the robot {robot.name!r} is"
            f" asked for chunks of {robot.action.horizon} × {robot.action.width}. Set"
            " embodiment=robomme_keyframes.",
        )
        require(
            not sections.memory and not sections.integration,
            "SAM2Act+ has a memory of its own: set memory=none integration=none.",
        )
        processor = processor_for(SAM2ActProcessor, processor, "sam2act_plus")
        return cls(SAM2ActNetwork(sizes), processor, config, **policy_options(cls, config))

    @property
    def info(self) -> PolicyInfo:
        """Rollouts end after the waypoints of an episode, which the processor's clock counts to."""
        if self.processor is None:
            return self._info
        return replace(self._info, max_actions=self.processor.waypoints)

    @info.setter
    def info(self, info: PolicyInfo) -> None:
        self._info = info

    @property
    def cube(self) -> Cube:
        """The workspace of the processor, else of the configuration."""
        if self.processor is not None:
            return self.processor.cube
        return Cube.of(PolicySections.of(self.config).processor["bounds"])

    # Training

    def training_noise(self, count: int, generator: torch.Generator) -> Noise:
        """Shifts and turns of `count` samples' clouds in [−1, 1], and offsets of the given
        rotations' bins.
        """
        shape = (count, self.keyframes)
        return {
            "shift": 2 * torch.rand(*shape, 3, generator=generator) - 1,
            "turn": 2 * torch.rand(shape, generator=generator) - 1,
            "told": torch.randint(*_BIN_OFFSETS, (*shape, 3), generator=generator),
        }

    def forward(
        self, batch: KeyframeBatch, noise: Mapping[str, Tensor] | None = None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The stage's loss, and its parts to log (detached)."""
        if noise is None:
            noise = self.training_noise(len(batch.points), torch.default_generator)
        sampled = map_noise(noise, lambda value: value.to(self.device))
        cube, sizes = self.cube, self.backbone.sizes
        augmentation = sampled if self.training and self.augment else None
        scenes = augmented(batch, batch.language, augmentation, cube, sizes.rotation_bins)
        with self.autocast():
            if self.stage == "first":
                offsets = sampled["told"].flatten(0, 1) if self.training else None
                parts = first_loss(self.backbone, scenes, cube, offsets)
            else:
                # The memory's stage learns the coarse heatmaps of sequences of keyframes.
                images = cloud_images(scenes.points, scenes.colours, cube, sizes.side)
                views = self.backbone.encode_views(images, scenes.state, scenes.language)
                logits = self.backbone.coarse_sequences(views, batch.points.shape[1])
                parts = {"heatmap": heatmap_loss(logits, scenes.target).mean()}
        loss = torch.stack(list(parts.values())).sum()
        metrics = {"loss": loss.detach()}
        for name, part in parts.items():
            metrics[name] = part.detach()
        return loss, metrics

    def recompute(self, mode: Recompute) -> None:
        self.backbone.recompute(mode)

    def shard_groups(self) -> Sequence[ShardGroup]:
        groups = [ShardGroup(self.backbone.encoder, full=True)]
        for branch in (self.backbone.coarse, self.backbone.fine):
            groups += map(ShardGroup, stacked_layers(branch.transformer))
        return groups

    # Sampling

    @torch.no_grad()
    def sample_actions(
        self,
        batch: KeyframeBatch,
        noise: Mapping[str, Tensor] | None = None,
        steps: int | None = None,
    ) -> Tensor:
        """The waypoint [b, 1, 7] after the last keyframe of each sequence; those before it are
        remembered.
        """
        waypoints = []
        colours = batch.colours.float() / 255
        last = batch.points.shape[1] - 1
        for i, points in enumerate(batch.points):
            remembered = BankState()
            for k in range(last + 1):
                scene = SceneInputs(points[k], colours[i, k], batch.state[i, k], batch.language[i])
                if k < last:
                    remembered = self.watch(scene, remembered)
                else:
                    waypoints.append(self._decide(scene, remembered)[0])
        return torch.stack(waypoints)[:, None]

    def watch(self, scene: SceneInputs, remembered: BankState) -> BankState:
        """What an episode remembers after a frame at which nothing is decided."""
        with self.autocast():
            return watch(self.backbone, scene.to(self.device), remembered, self.cube)

    def _decide(self, scene: SceneInputs, remembered: BankState) -> tuple[Tensor, BankState]:
        with self.autocast():
            finder = _point_finder(self.backbone.sizes.side, self.device)
            return decide(self.backbone, scene.to(self.device), remembered, self.cube, finder)

    # Episodes

    def frames_read(self, steps: np.ndarray, exec_start: int) -> None:
        """Any frame: keyframes of the video enter the bank."""
        return None

    def start_episode(self, goal: str, seed: int = 0) -> KeyframeEpisode:
        return KeyframeEpisode(self, goal, seed)

    def observation(self, episodes: "Sequence[Episode]") -> list[SceneInputs]:
        scenes = []
        for episode in episodes:
            assert isinstance(episode, KeyframeEpisode)
            scenes.append(episode.scene_inputs())
        return scenes

    def predict_chunk(
        self,
        batch: list[SceneInputs],
        episodes: "Sequence[Episode]",
        noise: Mapping[str, Tensor],
        steps: int | None = None,
    ) -> Tensor:
        """The next waypoints [n, 1, 7]; what is remembered of these keyframes counts from the next
        frames on.
        """
        waypoints = []
        for scene, episode in zip(batch, episodes, strict=True):
            assert isinstance(episode, KeyframeEpisode)
            action, after = self._decide(scene, episode.remembered)
            episode.decided(after)
            waypoints.append(action)
        return torch.stack(waypoints)[:, None]

    def require_processor(self) -> SAM2ActProcessor:
        processor = super().require_processor()
        assert isinstance(processor, SAM2ActProcessor)
        return processor

    @property
    def finetune_spec(self) -> FineTuneSpec:
        """`vision` is SAM2's encoder, of which only the `adapters` are trained."""
        return FineTuneSpec(
            components={
                "vision": r"backbone\.encoder\.vision\.(?!.*\.linear_[ab]_[qv]\.)",
                "adapters": r"backbone\.encoder\.vision\.",
                "memory": r"backbone\.memory\.",
                "action": "",
            },
            lora_targets=("to_q", "to_kv"),
            full_train=("heads",),
            frozen=rf"backbone\.(?!{STAGES[self.stage]})",
        )

    # Costs

    def full_batch(self, device: torch.device | str = "cpu") -> KeyframeBatch:
        """A batch of one without content, as the stage trains on it."""
        sizes, k = self.backbone.sizes, self.keyframes
        points = len(self.embodiment.cameras) * 128**2
        integers = torch.zeros(1, k, dtype=torch.int64, device=device)
        return KeyframeBatch(
            points=torch.zeros(1, k, points, 3, device=device),
            colours=torch.zeros(1, k, points, 3, dtype=torch.uint8, device=device),
            state=torch.zeros(1, k, sizes.state_dim, device=device),
            language=torch.zeros(1, sizes.words, sizes.language, device=device),
            target=torch.zeros(1, k, 3, device=device),
            rotation=torch.tensor([0.0, 0, 0, 1], device=device).expand(1, k, 4),
            gripper=integers,
            collision=integers.clone(),
        )


_point_finder = lru_cache(maxsize=2)(PointFinder)
