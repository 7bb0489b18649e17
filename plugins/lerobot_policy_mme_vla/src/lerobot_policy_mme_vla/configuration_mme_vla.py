"""What LeRobot's command line may say about a policy of mme-vla."""

from collections.abc import Collection
from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig

from mme_vla.embodiment import Camera, Embodiment
from mme_vla.errors import UserError, listed

STATE = "observation.state"
IS_DEMO = "observation.is_demo"
"""Whether a frame belongs to the conditioning video, [b, 1]; `--env.type=mme_vla` says so."""


@PreTrainedConfig.register_subclass("mme_vla")
@dataclass
class MMEVLAConfig(PreTrainedConfig):
    """A composition of mme-vla by its name, with overrides in the words of its own commands.

    model, overrides: `--policy.model=framesamp_modul
    --policy.overrides='["backbone=pi05","memory.budget=256"]'`. config_dir: a folder of YAML files
    of one's own, such as a robot's. init_from: weights to start from, in any format that mme-vla
    reads. composition: the whole configuration as JSON; saving writes it, so that a checkpoint
    needs no other file for it. exec_starts: side file of first execution frames, for datasets that
    do not mark their conditioning video. cache_root: folder of the vision caches that a memory
    trains on. max_build_frames: larger datasets have theirs built beforehand (`mme-vla cache`).
    cache_local: every machine has a `cache_root` of its own.
    freeze_vision: leave the vision tower as it is; a memory needs that.
    n_action_steps: actions of a chunk that are executed; by default the embodiment's. flow_steps:
    of the sampler. seed: of fresh weights, and of every episode's noise.
    """

    model: str = "framesamp_modul"
    overrides: list[str] = field(default_factory=list)
    config_dir: str | None = None
    init_from: str | None = None
    composition: str | None = None
    exec_starts: str | None = None
    cache_root: str | None = None
    cache_local: bool = False
    max_build_frames: int = 5000
    freeze_vision: bool = True
    n_action_steps: int | None = None
    flow_steps: int | None = None
    seed: int = 42
    # The policy's own processor normalises, relative to the state where the embodiment says so.
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(
            ("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY
        )
    )
    lr: float = 5e-5
    lr_end: float = 5e-5
    warmup: int = 1000
    decay_steps: int = 80_000

    def validate_features(self) -> None:
        """LeRobot asks at construction; `check_robot` can say more, once the
        embodiment is known.
        """

    def check_robot(self, robot: Embodiment) -> None:
        """Make sure that the dataset or environment has what this robot's policy reads and returns.

        Raises:
            UserError: a camera, the state or the action is missing, or of another width.
        """
        features = self.input_features or {}
        for camera in robot.cameras:
            image_key(camera, features)
        for what, feature, width in (
            (STATE, features.get(STATE), robot.state.width),
            ("action", self.action_feature, robot.action.width),
        ):
            shape = None if feature is None else tuple(feature.shape)
            if shape != (width,):
                raise UserError(
                    f"The robot {robot.name!r} needs the feature {what!r} of {width} numbers; "
                    + ("there is none. " if shape is None else f"its shape is {list(shape)}. ")
                    + "Datasets get LeRobot's names with `mme-vla convert … names=lerobot`."
                )

    def get_optimizer_preset(self) -> AdamWConfig:
        """The released recipe's."""
        return AdamWConfig(lr=self.lr, betas=(0.9, 0.95), weight_decay=1e-10, grad_clip_norm=1.0)

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig:
        """The released recipe's: a warm-up, and then, as `lr_end` is `lr`, constant."""
        return CosineDecayWithWarmupSchedulerConfig(
            peak_lr=self.lr,
            decay_lr=self.lr_end,
            num_decay_steps=self.decay_steps,
            num_warmup_steps=self.warmup,
        )

    @property
    def observation_delta_indices(self) -> None:
        """None: history comes from the vision cache, by a sample's `index`."""
        return None

    @property
    def action_delta_indices(self) -> None:
        """None: chunks come from the dataset as mme-vla reads it."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """None: there are no rewards."""
        return None


def image_key(camera: Camera, features: Collection[str]) -> str:
    """The feature that holds a camera's images: under its column's name, or its own.

    Raises:
        UserError: there is neither.
    """
    names = list(dict.fromkeys([camera.lerobot_key, f"observation.images.{camera.name}"]))
    doubled = f"observation.images.{camera.key}"  # of earlier folders of this plugin
    for name in (camera.key, *names, doubled):
        if name in features:
            return str(name)
    raise UserError(
        f"No images of the camera {camera.name!r}: none of {', '.join(names)} is among"
        f" {listed(sorted(features))}. For another robot, draft its file with `mme-vla inspect"
        " dataset=<folder>` and add --policy.config_dir=outputs/inspect"
        " --policy.overrides='[\"embodiment=<name>\"]'. For the same camera under another name, add"
        ' --rename_map=\'{"observation.images.<theirs>": "' + names[0] + "\"}'."
    )
