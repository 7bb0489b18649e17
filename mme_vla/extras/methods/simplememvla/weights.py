"""SimpleMemVLA's published folders (`model.safetensors`, `config.json`, `stats.json`, a tokenizer),
read and written.

Qwen3.5 itself, which training starts from, is read too. Tensors have the published names in this
library already.
"""

import json
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf, open_dict
from torch import Tensor

from mme_vla.config.sections import read_section
from mme_vla.errors import UserError, brief, listed
from mme_vla.extras.methods.simplememvla.config import NAME
from mme_vla.extras.methods.simplememvla.policy import SimpleMemVlaPolicy
from mme_vla.extras.methods.simplememvla.processor import TOKENIZER_FILE, processor_settings
from mme_vla.policy.base import Policy
from mme_vla.policy.saving import CONFIG
from mme_vla.policy.sections import PolicySections
from mme_vla.policy.tensor_files import WEIGHTS, cast
from mme_vla.processing.normalise import NormStats, QuantileStats
from mme_vla.utils import checked_file, read_json
from mme_vla.weights.tables import Adapter, Piece

STATS = "stats.json"
BASE = "Qwen/Qwen3.5-4B"
_LM_HEAD, _EMBEDDING = (
    "backbone.lm_head.weight",
    "backbone.model.language_model.embed_tokens.weight",
)
_IMAGE_KEY = "observation.images."
_STATISTICS = ("mean", "std", "q01", "q99", "min", "max")
_ONE_PERCENT = 2.326
"""Deviations from the mean to a normal distribution's 1 % quantile."""

KEYS = {
    "action_dim": "backbone.action_dim",
    "action_horizon": "backbone.horizon",
    "action_loss_weight": "backbone.action_weight",
    "vl_loss_weight": "backbone.words_weight",
    "dit_hidden_size": "backbone.head.width",
    "dit_depth": "backbone.head.depth",
    "dit_num_heads": "backbone.head.heads",
    "dit_mlp_ratio": "backbone.head.mlp_ratio",
    "dit_dropout": "backbone.head.dropout",
    "dit_rope_theta": "backbone.head.rope_theta",
    "dit_mrope_section": "backbone.head.rope_section",
    "dit_partial_rotary_factor": "backbone.head.rope_factor",
    "state_dropout_prob": "backbone.head.state_dropout",
    "timestep_beta_alpha": "backbone.head.time_alpha",
    "robot_tag": "processor.robot",
    "control_frequency_hz": "processor.control_hz",
    "history_video_sec": "processor.seconds",
    "history_video_fps": "processor.fps",
    "native_video_fps": "processor.native_fps",
    "variable_history": "processor.variable",
}
"""Keys of a published config.json → keys of a configuration here."""


Number = int | float
"""Whole numbers stay whole: compositions of policies are compared by their text."""


@dataclass(frozen=True)
class PublishedConfig:
    """What a published config.json says, in its own keys.

    backbone_config: Qwen3.5's own configuration. state_dim: of the robot, also where `use_proprio`
    leaves the state out. image_keys: cameras in the order in which they are shown.
    history_image_keys: those with a video.
    """

    backbone_config: Mapping[str, Any]
    action_dim: int
    action_horizon: int
    action_loss_weight: Number
    vl_loss_weight: Number
    use_proprio: bool
    state_dim: int
    dit_hidden_size: int
    dit_depth: int
    dit_num_heads: int
    dit_mlp_ratio: Number
    dit_dropout: Number
    dit_rope_theta: Number
    dit_mrope_section: tuple[int, int, int]
    dit_partial_rotary_factor: Number
    state_dropout_prob: Number
    timestep_beta_alpha: Number
    robot_tag: str
    control_frequency_hz: Number
    history_video_sec: Number
    history_video_fps: Number
    native_video_fps: Number
    variable_history: bool
    image_keys: tuple[str, ...]
    history_image_keys: tuple[str, ...] = ()
    timestep_beta_beta: float = 1.0
    model_type: Literal["simplememvla"] | None = None

    def __post_init__(self) -> None:
        if self.timestep_beta_beta != 1.0:
            raise UserError(
                f"config.json: timestep_beta_beta={self.timestep_beta_beta:g}; only 1 is supported."
            )

    @classmethod
    def read(cls, config: Mapping[str, Any]) -> Self:
        """Read a config.json; keys that say nothing of the network are left out."""
        return read_section(cls, config, "config.json", others=True)

    @classmethod
    def of(cls, policy: SimpleMemVlaPolicy) -> Self:
        """What the config.json of a policy says."""
        sizes, robot = policy.sizes, policy.embodiment
        settings = processor_settings(policy.config)
        return cls(
            backbone_config=sizes.qwen.to_dict(),
            action_dim=sizes.action_dim,
            action_horizon=sizes.horizon,
            action_loss_weight=sizes.action_weight,
            vl_loss_weight=sizes.words_weight,
            use_proprio=sizes.state_dim > 0,
            state_dim=sizes.state_dim or robot.state.width,
            dit_hidden_size=sizes.head.width,
            dit_depth=sizes.head.depth,
            dit_num_heads=sizes.head.heads,
            dit_mlp_ratio=sizes.head.mlp_ratio,
            dit_dropout=sizes.head.dropout,
            dit_rope_theta=sizes.head.rope_theta,
            dit_mrope_section=sizes.head.rope_section,
            dit_partial_rotary_factor=sizes.head.rope_factor,
            state_dropout_prob=sizes.head.state_dropout,
            timestep_beta_alpha=sizes.head.time_alpha,
            robot_tag=settings.robot,
            control_frequency_hz=_whole(settings.control_hz),
            history_video_sec=_whole(settings.seconds),
            history_video_fps=_whole(settings.fps),
            native_video_fps=_whole(settings.native_fps),
            variable_history=settings.variable,
            image_keys=tuple(_IMAGE_KEY + name for name in robot.camera_names),
            history_image_keys=(_IMAGE_KEY + robot.memory_camera,),
            model_type="simplememvla",
        )

    def configure(self, config: DictConfig) -> None:
        """Set the keys of a configuration that it names."""
        with open_dict(config):
            for name, key in KEYS.items():
                value = getattr(self, name)
                OmegaConf.update(config, key, list(value) if isinstance(value, tuple) else value)
            config.backbone.name = NAME
            config.backbone.vlm = dict(self.backbone_config)
            config.backbone.state_dim = self.state_dim if self.use_proprio else 0


def is_simplememvla(names: Iterable[str]) -> bool:
    """Whether tensors are named as in the published checkpoints, or as in Qwen3.5's."""
    present = set(names)
    tower, words = "model.visual.pos_embed.weight", "model.language_model.embed_tokens.weight"
    return {tower, words} <= present or {f"backbone.{tower}", f"backbone.{words}"} <= present


def read_names(tensors: Mapping[str, Tensor], source: Path) -> dict[str, Tensor]:
    """Tensors under the published names: Qwen3.5's get the prefix, and its multi-token prediction
    is left out.
    """
    named = {
        name if name.startswith(("backbone.", "action_head.")) else f"backbone.{name}": tensor
        for name, tensor in tensors.items()
        if not name.startswith("mtp.")
    }
    if (
        _LM_HEAD in named
        and _EMBEDDING in named
        and named[_LM_HEAD].shape != named[_EMBEDDING].shape
    ):
        raise UserError(
            f"{source}: the language head is not as large as the embedding, to which it is tied."
        )
    return named


def simplememvla_adapter(policy: Policy) -> Adapter:
    """The published names of this policy's tensors; Qwen3.5, to start from, lacks the
    action head.
    """
    names = simplememvla_of(policy).state_dict()
    component = policy.finetune_spec.component_of
    table = {name: [Piece(name)] for name in names if component(name) != "memory"}
    fresh = frozenset(name for name in names if component(name) in ("memory", "action"))
    return Adapter(table, tied={_LM_HEAD: _EMBEDDING}, fresh=fresh)


def simplememvla_of(policy: Policy) -> SimpleMemVlaPolicy:
    """The policy, where it is SimpleMemVLA."""
    if not isinstance(policy, SimpleMemVlaPolicy):
        raise UserError(
            "This format holds SimpleMemVLA;"
            f" {PolicySections.of(policy.config).name or 'this'} is a {type(policy).__name__}. Set"
            " model=simplememvla."
        )
    return policy


def _whole(number: float) -> Number:
    return int(number) if number.is_integer() else number


# config.json


def configured(cfg: DictConfig, config: Mapping[str, Any], folder: Path) -> DictConfig:
    """A composed configuration as a published checkpoint says: sizes, window, robot's words, rates,
    its tokenizer.
    """
    if (folder / TOKENIZER_FILE).is_file():
        cfg.processor.tokenizer = str(checked_file(folder, TOKENIZER_FILE, "tokenizer"))
    if "backbone_config" in config:
        published = PublishedConfig.read(config)
        published.configure(cfg)
        cfg.embodiment.action.horizon = published.action_horizon
        cfg.embodiment.fps = published.native_video_fps
    return cfg


def check_config(policy: Policy, config: Mapping[str, Any], source: str) -> None:
    """Refuse a published checkpoint that was trained with another video, robot or head than the
    policy's.
    """
    if "action_dim" not in config:  # of Qwen3.5, or none
        return
    target = simplememvla_of(policy)
    if target.memory is not None:
        raise UserError(
            f"{source} shows a video and this policy has a memory in its place, whose weights would"
            " stay unset. To begin training from it use start_from() (on the command line:"
            " init_from=…)."
        )
    published, expected = PublishedConfig.read(config), PublishedConfig.of(target)
    for name, key in KEYS.items():
        value, has = getattr(published, name), getattr(expected, name)
        if value != has:
            raise UserError(
                f"{source} was trained with {key}={brief(value)}; this policy has {brief(has)}. Set"
                f" {key}={brief(value)}."
            )
    state_dim = published.state_dim if published.use_proprio else 0
    if state_dim != target.sizes.state_dim:
        raise UserError(
            f"{source} was trained with backbone.state_dim={state_dim}; this policy has"
            f" {target.sizes.state_dim}. Set backbone.state_dim={state_dim}."
        )
    robot = target.embodiment
    if published.image_keys != expected.image_keys:
        raise UserError(
            f"{source} sees {listed(published.image_keys)}; the robot {robot.name!r} has"
            f" {listed(robot.camera_names)}."
        )
    if published.history_image_keys not in ((), expected.history_image_keys):
        raise UserError(
            f"{source} shows a video of {listed(published.history_image_keys)}; here it is the"
            f" memory camera's, {robot.memory_camera!r} (embodiment.memory_camera)."
        )


# stats.json


def read_published_stats(folder: Path) -> NormStats | None:
    """The statistics of `stats.json`, where it is one of LeRobot's form.

    Only mean and deviation count for this policy. Where a file has no quantiles, a normal
    distribution's are taken.
    """
    if not (folder / STATS).is_file():
        return None
    features = read_json(
        checked_file(folder, STATS, "statistics"), "normalisation statistics", limit=2**24
    )
    stats = {}
    for name, key in {"state": "observation.state", "actions": "action"}.items():
        feature = features.get(key)
        if not isinstance(feature, dict):
            return None
        values = {key: feature[key] for key in _STATISTICS if key in feature}
        if {"mean", "std"} <= set(values) and not {"q01", "q99"} <= set(values):
            mean = np.asarray(values["mean"], np.float64)
            std = np.asarray(values["std"], np.float64)
            values["q01"] = (mean - _ONE_PERCENT * std).tolist()
            values["q99"] = (mean + _ONE_PERCENT * std).tolist()
        stats[name] = QuantileStats.from_dict(values, f"{folder / STATS}: {name}")
    return NormStats(**stats)


def write_simplememvla(
    policy: Policy, folder: Path, dtype: torch.dtype, stats: NormStats | None
) -> None:
    """A folder as the authors publish it; the image processors' files are Qwen3.5's own and not
    written.
    """
    from safetensors.torch import save_file

    target = simplememvla_of(policy)
    released = simplememvla_adapter(policy).export(policy.state_dict())
    tensors = {
        name: cast(released[name].detach(), dtype).cpu().contiguous() for name in sorted(released)
    }
    tensors[_LM_HEAD] = tensors[_LM_HEAD].clone()  # tied, and published under both names
    save_file(tensors, folder / WEIGHTS, metadata={"format": "pt"})
    # Beside what is read here, keys that the authors' code expects
    config = asdict(PublishedConfig.of(target)) | {
        "backbone_model_name_or_path": BASE,
        "hidden_size": target.sizes.width,
        "freeze_backbone": False,
        "subtask_key": "subtask",
        "subtask_index_key": "subtask_online_index",
    }
    (folder / CONFIG).write_text(json.dumps(config, indent=2) + "\n")
    if target.processor is not None:
        (folder / TOKENIZER_FILE).write_text(
            target.require_processor().tokenizer.content, encoding="utf-8"
        )
    else:  # on meta: the file that the configuration names, if it is one
        tokenizer = Path(processor_settings(target.config).tokenizer)
        if tokenizer.is_file():
            shutil.copyfile(tokenizer, folder / TOKENIZER_FILE)
    if stats is not None:
        features = {"observation.state": stats.state.to_dict(), "action": stats.actions.to_dict()}
        (folder / STATS).write_text(json.dumps(features, indent=2) + "\n")
