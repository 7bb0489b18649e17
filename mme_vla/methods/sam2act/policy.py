"""`SAM2ActPolicy`: from coloured points to the next waypoint, with a memory of keyframes."""

import re
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor, nn

from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import UserError, brief, did_you_mean
from mme_vla.methods.sam2act.config import SAM2ActSizes
from mme_vla.methods.sam2act.episode import KeyframeEpisode, SceneInputs, decide, watch
from mme_vla.methods.sam2act.geometry import Cube, PointFinder
from mme_vla.methods.sam2act.losses import augmentation_draws, augmented, first_loss, memory_loss
from mme_vla.methods.sam2act.memory import BankState
from mme_vla.methods.sam2act.model import SAM2ActNetwork
from mme_vla.methods.sam2act.processor import NAME, KeyframeBatch, SAM2ActProcessor
from mme_vla.policy.base import Policy
from mme_vla.policy.saving import policy_options
from mme_vla.policy.tensor_files import dtype_of
from mme_vla.registry import POLICIES
from mme_vla.speed.recompute import Recompute
from mme_vla.speed.sharding import ShardGroup, stacked_layers
from mme_vla.types import Noise, map_noise

if TYPE_CHECKING:
    from mme_vla.policy.episode import Episode
    from mme_vla.processing.base import PolicyProcessor


STAGES = {
    "first": r"coarse\.|fine\.|encoder\.vision\..*\.linear_[ab]_[qv]\.",
    "memory": r"memory\.|encoder\.fine\.|encoder\.middle\.|coarse\.decoder\.",
}
"""Stage → pattern of the parameters that learn in it, as the authors froze the others."""


def check_stage(stage: str) -> str:
    """Return the stage's name."""
    if stage not in STAGES:
        raise UserError(f"Unknown training stage {brief(stage)} of SAM2Act+. {did_you_mean(str(stage), STAGES)}")
    return stage


def select_trained(network: nn.Module, stage: str) -> list[nn.Parameter]:
    """Freeze what a stage does not train, and return what it does."""
    check_stage(stage)
    trained = []
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(re.match(STAGES[stage], name) is not None)
        if parameter.requires_grad:
            trained.append(parameter)
    return trained


WIDTH = 7
"""Numbers of a waypoint: position, roll-pitch-yaw, gripper."""


@POLICIES.register(NAME)
class SAM2ActPolicy(Policy):
    """SAM2Act+ (RoboMME's fine-tuned model): one waypoint at a time, which the benchmark's planner moves to."""

    processor: SAM2ActProcessor | None
    memory = None  # its memory stands inside the network, between transformer and decoder
    lora_targets = ("to_q", "to_kv")
    heads = ("heads",)
    PARTS: Mapping[str, str] = {
        "vision": r"backbone\.encoder\.vision\.(?!.*\.linear_[ab]_[qv]\.)",
        "adapters": r"backbone\.encoder\.vision\.",
        "memory": r"backbone\.memory\.",
        "action": "",
    }

    def __init__(
        self,
        backbone: SAM2ActNetwork,
        processor: SAM2ActProcessor | None = None,
        config: Mapping[str, Any] | None = None,
        *,
        stage: str = "memory",
        compute_dtype: str = "float32",
        history_dtype: str = "bfloat16",
        augment: bool = True,
    ) -> None:
        """Put the parts together.

        Args:
            processor: needed for episodes and data; the network alone runs on ready batches without it.
            config: what `from_config` was given; saved with the weights.
            stage: which of the authors' two stages trains: `first` or `memory`.
            compute_dtype: as for `MMEPolicy`; the authors train in float16. history_dtype: of no use here.
            augment: shift and turn clouds while training.
        """
        super().__init__()
        self.backbone, self.processor = backbone, processor
        self.config = dict(config or {})
        self.stage, self.augment = check_stage(stage), augment
        self.compute_dtype = dtype_of(compute_dtype, "policy.compute_dtype")
        self.history_dtype = dtype_of(history_dtype, "policy.history_dtype")
        self.frozen = rf"backbone\.(?!{STAGES[stage]})"
        self.horizon, self.action_dim = 1, WIDTH
        # Single keyframes first, then one more than can be remembered.
        self.keyframes = 1 if stage == "first" else backbone.sizes.remembered + 1

    @classmethod
    def from_config(
        cls, config: Mapping[str, Any], processor: "PolicyProcessor | None" = None, *, fresh_backbone: bool = True
    ) -> Self:
        """Build from plain sections `backbone`, `embodiment`, `policy`."""
        sizes, robot = SAM2ActSizes.from_dict(config["backbone"]), embodiment_of(config)
        if robot.action.width != WIDTH or robot.action.frames is not None or robot.action.horizon != 1:
            raise UserError(
                f"SAM2Act+ answers with one planned motion of {WIDTH} numbers; the robot {robot.name!r} is asked for "
                f"chunks of {robot.action.horizon} × {robot.action.width}. Set embodiment=robomme_keyframes."
            )
        if config.get("memory") or config.get("integration"):
            raise UserError("SAM2Act+ has a memory of its own: set memory=none integration=none.")
        if processor is not None and not isinstance(processor, SAM2ActProcessor):
            raise UserError("SAM2Act+ needs its own processor: set processor=sam2act_plus.")
        return cls(SAM2ActNetwork(sizes), processor, config, **policy_options(cls, config))

    def compute_unsaved(self) -> None:
        """Give the heads' constants their values, where they were built on meta; nothing else is computed."""
        heads = self.backbone.fine.heads
        assert heads is not None
        heads.compute_rates(self.device)

    @property
    def max_actions(self) -> int | None:  # type: ignore[override]
        """Waypoints of an episode, which its clock counts to."""
        return None if self.processor is None else self.processor.waypoints

    @property
    def most_remembered(self) -> int:
        """Keyframes that are read, and kept."""
        return self.backbone.sizes.remembered

    @property
    def cube(self) -> Cube:
        """The part of the world that is looked at: its processor's, else its configuration's."""
        return Cube.of(self.config["processor"]["bounds"]) if self.processor is None else self.processor.cube

    def autocast(self) -> torch.autocast:
        """The context all network code runs in."""
        kind = self.device.type if self.device.type != "meta" else "cpu"
        return torch.autocast(kind, self.compute_dtype, enabled=self.compute_dtype != torch.float32)

    # Training

    def training_noise(self, count: int, generator: torch.Generator) -> Noise:
        """Shifts and turns of `count` samples' clouds, and how far off the told rotations are."""
        return augmentation_draws(count, self.keyframes, generator)

    def forward(
        self, batch: KeyframeBatch, draws: Mapping[str, Tensor] | None = None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The stage's loss, and its parts to log (detached)."""
        values = self.training_noise(len(batch.points), torch.default_generator) if draws is None else draws
        sampled = map_noise(values, lambda value: value.to(self.device))
        cube, sizes = self.cube, self.backbone.sizes
        augmentation = sampled if self.training and self.augment else None
        scenes = augmented(batch, batch.language, augmentation, cube, sizes.rotation_bins)
        with self.autocast():
            if self.stage == "first":
                offsets = sampled["told"].flatten(0, 1) if self.training else None
                parts = first_loss(self.backbone, scenes, cube, offsets)
            else:
                parts = memory_loss(self.backbone, scenes, cube, batch.points.shape[1])
        loss = torch.stack(list(parts.values())).sum()
        return loss, {"loss": loss.detach(), **{name: part.detach() for name, part in parts.items()}}

    def recompute(self, mode: Recompute) -> None:
        """Compute the layers' activations again in the backward pass instead of keeping them, or keep them."""
        self.backbone.recompute(mode)

    def shard_groups(self) -> Sequence[ShardGroup]:
        """SAM2's encoder, and every layer of both transformers."""
        stages = (self.backbone.coarse, self.backbone.fine)
        layers = [ShardGroup(layer) for stage in stages for layer in stacked_layers(stage.transformer)]
        return [ShardGroup(self.backbone.encoder, full=True), *layers]

    # Sampling

    @torch.no_grad()
    def sample_actions(
        self, batch: KeyframeBatch, draws: Mapping[str, Tensor] | None = None, steps: int | None = None
    ) -> Tensor:
        """The waypoint [b, 1, 7] after the last keyframe of each sequence; those before it are remembered."""
        waypoints = []
        for i in range(len(batch.points)):
            state = BankState()
            scenes = [self._scene_of(batch, i, k) for k in range(batch.points.shape[1])]
            for earlier in scenes[:-1]:
                state = self.watch(earlier, state)
            waypoints.append(self._decide(scenes[-1], state)[0])
        return torch.stack(waypoints)[:, None]

    def _scene_of(self, batch: KeyframeBatch, sample: int, keyframe: int) -> SceneInputs:
        colours = batch.colours[sample, keyframe].float() / 255
        return SceneInputs(
            batch.points[sample, keyframe], colours, batch.state[sample, keyframe], batch.language[sample]
        )

    def watch(self, scene: SceneInputs, remembered: BankState) -> BankState:
        """What an episode remembers after a frame at which nothing is decided."""
        with self.autocast():
            return watch(self.backbone, scene.to(self.device), remembered, self.cube)

    def _decide(self, scene: SceneInputs, remembered: BankState) -> tuple[Tensor, BankState]:
        cube = self.cube
        with self.autocast():
            return decide(self.backbone, scene.to(self.device), remembered, cube, self._finder)

    @cached_property
    def _finder(self) -> PointFinder:
        return PointFinder(self.backbone.sizes.side, self.device)

    # Episodes

    def start_episode(self, goal: str, seed: int = 0) -> KeyframeEpisode:
        """Begin an episode with an empty bank."""
        return KeyframeEpisode(self, goal, seed)

    def observation(self, episodes: "Sequence[Episode]") -> list[SceneInputs]:
        """What running episodes see now."""
        return [episode.scene_inputs() for episode in episodes if isinstance(episode, KeyframeEpisode)]

    def answer(
        self,
        batch: list[SceneInputs],
        episodes: "Sequence[Episode]",
        draws: Mapping[str, Tensor],
        steps: int | None = None,
    ) -> Tensor:
        """The next waypoints [n, 1, 7]; what is remembered of these keyframes counts from the next frames on."""
        waypoints = []
        for scene, episode in zip(batch, episodes, strict=True):
            assert isinstance(episode, KeyframeEpisode)
            action, after = self._decide(scene, episode.remembered)
            episode.decided(after)
            waypoints.append(action)
        return torch.stack(waypoints)[:, None]

    def require_processor(self) -> SAM2ActProcessor:
        """Return the processor, or say what it takes to have one."""
        processor = super().require_processor()
        assert isinstance(processor, SAM2ActProcessor)
        return processor

    def check_processor(self, source: str) -> None:
        """See `Saved`."""
        super().check_processor(source)
        text, sizes = self.require_processor().text, self.backbone.sizes
        for name, actual, expected in (("language", text.width, sizes.language), ("words", text.words, sizes.words)):
            if actual != expected:
                raise UserError(
                    f"{source}: the processor's {name} is {brief(actual)}, the network's {expected}. The files are "
                    "from two checkpoints, or one was changed."
                )

    # Costs and parts

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

    def warm_up_vision(self) -> None:
        """Run the encoder on the virtual images of nothing."""
        side = self.backbone.encoder.side
        self.backbone.encoder(torch.zeros(3, 3, side, side, device=self.device))

    def parts(self) -> Mapping[str, str]:
        """`vision` is SAM2's encoder, which never learns but for its `adapters`."""
        return self.PARTS
