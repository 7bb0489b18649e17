"""SimpleMemVLA's published folders (`model.safetensors`, `config.json`, `stats.json`, a tokenizer),
read and written.

Qwen3.5 itself, which training starts from, is read too. Tensors have the published names in this
library already.
"""

import json
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_origin, get_type_hints

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf, open_dict
from torch import Tensor

from mme_vla.config.sections import read_section
from mme_vla.errors import UserError, brief, listed, require
from mme_vla.extras.methods.simplememvla.config import NAME
from mme_vla.extras.methods.simplememvla.policy import SimpleMemVlaPolicy
from mme_vla.extras.methods.simplememvla.processor import TOKENIZER_FILE, processor_settings
from mme_vla.policy.base import Policy
from mme_vla.policy.saving import CONFIG
from mme_vla.policy.tensor_files import WEIGHTS, cast
from mme_vla.processing.normalise import NormStats, QuantileStats
from mme_vla.utils import checked_file, read_json
from mme_vla.weights.tables import Adapter, Piece, wrong_policy

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

Number = int | float
"""Whole numbers stay whole: compositions of policies are compared by their text."""


@dataclass(frozen=True)
class PublishedConfig:
    """The content of a published config.json, in its own keys.

    backbone_config: Qwen3.5's own configuration.
    state_dim: of the robot, also where `use_proprio` leaves the state out.
    image_keys: cameras in the order in which they are shown.
    history_image_keys: those with a video. The text beside a type is the key of a configuration
        here with the same value.
    """

    backbone_config: Mapping[str, Any]
    action_dim: Annotated[int, "backbone.action_dim"]
    action_horizon: Annotated[int, "backbone.horizon"]
    action_loss_weight: Annotated[Number, "backbone.action_weight"]
    vl_loss_weight: Annotated[Number, "backbone.words_weight"]
    use_proprio: bool
    state_dim: int | None
    dit_hidden_size: Annotated[int, "backbone.head.width"]
    dit_depth: Annotated[int, "backbone.head.depth"]
    dit_num_heads: Annotated[int, "backbone.head.heads"]
    dit_mlp_ratio: Annotated[Number, "backbone.head.mlp_ratio"]
    dit_dropout: Annotated[Number, "backbone.head.dropout"]
    dit_rope_theta: Annotated[Number, "backbone.head.rope_theta"]
    dit_mrope_section: Annotated[tuple[int, int, int], "backbone.head.rope_section"]
    dit_partial_rotary_factor: Annotated[Number, "backbone.head.rope_factor"]
    state_dropout_prob: Annotated[Number, "backbone.head.state_dropout"]
    timestep_beta_alpha: Annotated[Number, "backbone.head.time_alpha"]
    robot_tag: Annotated[str | None, "processor.robot"]
    control_frequency_hz: Annotated[Number, "processor.control_hz"]
    history_video_sec: Annotated[Number, "processor.seconds"]
    history_video_fps: Annotated[Number, "processor.fps"]
    native_video_fps: Annotated[Number | None, "processor.native_fps"]
    variable_history: Annotated[bool, "processor.variable"]
    image_keys: tuple[str, ...]
    history_image_keys: tuple[str, ...] | None = None
    timestep_beta_beta: float = 1.0
    model_type: Literal["simplememvla"] | None = None

    @classmethod
    def read(cls, config: Mapping[str, Any], source: str | Path) -> Self:
        """Read a config.json; keys that do not concern the network are left out.

        source: its folder, for messages.
        """
        where = f"{source}: {CONFIG}"
        needed = [spec.name for spec in fields(cls) if spec.default is MISSING]
        lacking = [name for name in needed if name not in config]
        require(not lacking, f"{where} is no SimpleMemVLA's: it lacks {listed(lacking)}.")
        published = read_section(cls, config, where, others=True)
        beta = published.timestep_beta_beta
        require(beta == 1, f"{where}: timestep_beta_beta={beta:g}; only 1 is supported.")
        require(
            published.state_dim is not None or not published.use_proprio,
            f"{where}: state_dim=None must be a whole number, because use_proprio is true.",
        )
        return published

    @classmethod
    def of(cls, policy: SimpleMemVlaPolicy) -> Self:
        """The content of the config.json of a policy."""
        sizes, robot = policy.sizes, policy.embodiment
        settings = processor_settings(policy.config)
        values: dict[str, Any] = {}
        for name, key in KEYS.items():
            section, _, part = key.partition(".")
            if section == "backbone":
                values[name] = attrgetter(part)(sizes)
                continue
            value = getattr(settings, part)
            if isinstance(value, float) and value.is_integer():
                value = int(value)
            values[name] = value
        return cls(
            **values,
            backbone_config=sizes.qwen.to_dict(),
            use_proprio=sizes.state_dim > 0,
            state_dim=sizes.state_dim or robot.state.width,
            image_keys=tuple(_IMAGE_KEY + name for name in robot.camera_names),
            history_image_keys=(_IMAGE_KEY + robot.memory_camera,),
            model_type=NAME,
        )

    def settings(self) -> dict[str, Any]:
        """Keys of a configuration here → values, as a command line takes them."""
        values: dict[str, Any] = {}
        for name, key in KEYS.items():
            value = getattr(self, name)
            values[key] = list(value) if isinstance(value, tuple) else value
        values["backbone.state_dim"] = self.state_dim if self.use_proprio else 0
        return values

    def configure(self, config: DictConfig) -> None:
        """Set the keys of a configuration that it names."""
        with open_dict(config):
            for key, value in self.settings().items():
                OmegaConf.update(config, key, value)
            config.backbone.name = NAME
            config.backbone.vlm = dict(self.backbone_config)


KEYS: dict[str, str] = {
    name: kind.__metadata__[0]
    for name, kind in get_type_hints(PublishedConfig, include_extras=True).items()
    if get_origin(kind) is Annotated
}
"""Keys of a published config.json → keys of a configuration here."""


def is_simplememvla(names: Iterable[str]) -> bool:
    """Whether tensors are named as in the published checkpoints, or as in Qwen3.5's."""
    present = set(names)
    tower, words = "model.visual.pos_embed.weight", "model.language_model.embed_tokens.weight"
    return {tower, words} <= present or {f"backbone.{tower}", f"backbone.{words}"} <= present


def read_names(tensors: Mapping[str, Tensor], source: Path) -> dict[str, Tensor]:
    """Tensors under the published names: Qwen3.5's get the prefix, and its multi-token prediction
    is left out.
    """
    named = {}
    for name, tensor in tensors.items():
        if name.startswith("mtp."):
            continue
        prefix = "" if name.startswith(("backbone.", "action_head.")) else "backbone."
        named[prefix + name] = tensor
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
        raise wrong_policy(policy, "SimpleMemVLA", "model=simplememvla")
    return policy


# config.json


def configured(cfg: DictConfig, config: Mapping[str, Any], folder: Path) -> DictConfig:
    """A composed configuration as a published checkpoint says: sizes, window, robot's words, rates,
    its tokenizer.
    """
    if (folder / TOKENIZER_FILE).is_file():
        cfg.processor.tokenizer = str(checked_file(folder, TOKENIZER_FILE, "tokenizer"))
    if "backbone_config" in config:
        published = PublishedConfig.read(config, folder)
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
    published, expected = PublishedConfig.read(config, source), PublishedConfig.of(target)
    current = expected.settings()
    for key, value in published.settings().items():
        if value != current[key]:
            raise UserError(
                f"{source} was trained with {key}={brief(value)}; this policy has"
                f" {brief(current[key])}. Set {key}={brief(value)}."
            )
    robot = target.embodiment
    if published.image_keys != expected.image_keys:
        raise UserError(
            f"{source} sees {listed(published.image_keys)}; the robot {robot.name!r} has"
            f" {listed(robot.camera_names)}."
        )
    video_keys = published.history_image_keys or ()
    if video_keys not in ((), expected.history_image_keys):
        raise UserError(
            f"{source} shows a video of {listed(video_keys)}; here it is the"
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
    tensors = {}
    for name in sorted(released):
        tensors[name] = cast(released[name].detach(), dtype).cpu().contiguous()
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
    (folder / CONFIG).write_text(json.dumps(config, indent=2) + "\n", encoding="utf-8")
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
        (folder / STATS).write_text(json.dumps(features, indent=2) + "\n", encoding="utf-8")
