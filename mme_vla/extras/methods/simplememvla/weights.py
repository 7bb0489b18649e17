"""SimpleMemVLA's published folders (`model.safetensors`, `config.json`, `stats.json`, a tokenizer),
read and written.

Qwen3.5 itself, which training starts from, is read too. Tensors have the published names in this
library already.
"""

import json
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf, open_dict
from torch import Tensor

from mme_vla.errors import UserError, brief, listed
from mme_vla.extras.methods.simplememvla.config import NAME
from mme_vla.extras.methods.simplememvla.policy import SimpleMemVlaPolicy
from mme_vla.extras.methods.simplememvla.processor import TOKENIZER_FILE
from mme_vla.policy.base import Policy
from mme_vla.policy.saving import CONFIG
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
_ONE_PERCENT = 2.326
"""Deviations from the mean to a normal distribution's 1 % quantile."""

HEAD_KEYS = {
    "dit_hidden_size": "width",
    "dit_depth": "depth",
    "dit_num_heads": "heads",
    "dit_mlp_ratio": "mlp_ratio",
    "dit_dropout": "dropout",
    "dit_rope_theta": "rope_theta",
    "dit_mrope_section": "rope_section",
    "dit_partial_rotary_factor": "rope_factor",
    "state_dropout_prob": "state_dropout",
    "timestep_beta_alpha": "time_alpha",
}
BACKBONE_KEYS = {
    "action_dim": "action_dim", "action_horizon": "horizon", "action_loss_weight": "action_weight",
    "vl_loss_weight": "words_weight",
}  # fmt: skip
PROCESSOR_KEYS = {
    "robot_tag": "robot", "control_frequency_hz": "control_hz", "history_video_sec": "seconds",
    "history_video_fps": "fps", "native_video_fps": "native_fps", "variable_history": "variable",
}  # fmt: skip
"""Keys of a published config.json → keys of our sections `backbone.head`, `backbone` and
`processor`.
"""


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
            f"This format holds SimpleMemVLA; {policy.config.get('name', 'this')} is a"
            f" {type(policy).__name__}. Set model=simplememvla."
        )
    return policy


# config.json


def backbone_section(config: Mapping[str, Any]) -> dict[str, Any]:
    """Our section `backbone` of a published config.json, without sizes that only costs
    depend on.
    """
    _check_config(config)
    return {
        "name": NAME,
        "vlm": dict(config["backbone_config"]),
        "head": {target_key: config[source_key] for source_key, target_key in HEAD_KEYS.items()},
        **{target_key: config[source_key] for source_key, target_key in BACKBONE_KEYS.items()},
        "state_dim": config["state_dim"] if config["use_proprio"] else 0,
    }


def processor_section(config: Mapping[str, Any]) -> dict[str, Any]:
    """What a published config.json says of our section `processor`."""
    _check_config(config)
    return {target_key: config[source_key] for source_key, target_key in PROCESSOR_KEYS.items()}


def _check_config(config: Mapping[str, Any]) -> None:
    if config.get("model_type") not in (NAME, None):
        raise UserError(
            f"config.json: model_type={brief(config['model_type'])}, where SimpleMemVLA's is"
            f" {NAME!r}."
        )
    needed = (
        "backbone_config",
        *HEAD_KEYS,
        *BACKBONE_KEYS,
        *PROCESSOR_KEYS,
        "use_proprio",
        "state_dim",
        "image_keys",
    )
    if lacking := [key for key in needed if key not in config]:
        raise UserError(f"config.json is no SimpleMemVLA's: it lacks {listed(lacking)}.")
    if config.get("timestep_beta_beta", 1.0) != 1.0:
        raise UserError(
            f"config.json: timestep_beta_beta={brief(config['timestep_beta_beta'])}; only 1 is"
            " supported."
        )
    if not isinstance(config["backbone_config"], Mapping):
        raise UserError("config.json: backbone_config must be a Qwen3.5's configuration.")


def configured(cfg: DictConfig, config: Mapping[str, Any], folder: Path) -> DictConfig:
    """A composed configuration as a published checkpoint says: sizes, window, robot's words, rates,
    its tokenizer.
    """
    if (folder / TOKENIZER_FILE).is_file():
        cfg.processor.tokenizer = str(checked_file(folder, TOKENIZER_FILE, "tokenizer"))
    if not config or "backbone_config" not in config:
        return cfg
    with open_dict(cfg):
        cfg.backbone = OmegaConf.merge(cfg.backbone, backbone_section(config) | {"vlm": None})
        cfg.backbone.vlm = dict(config["backbone_config"])
        cfg.processor = OmegaConf.merge(cfg.processor, processor_section(config))
        cfg.embodiment.action.horizon = config["action_horizon"]
        cfg.embodiment.fps = config["native_video_fps"]
    return cfg


def check_config(policy: Policy, config: Mapping[str, Any], source: str) -> None:
    """Refuse a published checkpoint that was trained with another video, robot or head than the
    policy's.
    """
    if not config or "action_dim" not in config:  # of Qwen3.5, or none
        return
    target = simplememvla_of(policy)
    if target.memory is not None:
        raise UserError(
            f"{source} shows a video and this policy has a memory in its place, whose weights would"
            " stay unset. To begin training from it use start_from() (on the command line:"
            " init_from=…)."
        )
    sections = {"backbone": backbone_section(config), "processor": processor_section(config)}
    for section, expected in sections.items():
        current = dict(target.config[section])
        for key, value in expected.items():
            if key == "vlm":
                continue
            # (dotted name, the source's value, the policy's)
            triples = [(f"{section}.{key}", value, current.get(key))]
            if isinstance(value, dict):
                triples = [
                    (f"{section}.{key}.{name}", member, current[key].get(name))
                    for name, member in value.items()
                ]
            for name, source_value, has in triples:
                if isinstance(has, tuple):
                    has = list(has)
                if has != source_value:
                    raise UserError(
                        f"{source} was trained with {name}={brief(source_value)}; this policy has"
                        f" {brief(has)}. Set {name}={brief(source_value)}."
                    )
    robot = target.embodiment
    if [*config["image_keys"]] != [_IMAGE_KEY + name for name in robot.camera_names]:
        cameras = listed(robot.camera_names)
        raise UserError(
            f"{source} sees {listed(config['image_keys'])}; the robot {robot.name!r} has {cameras}."
        )
    if list(config.get("history_image_keys", [])) not in ([], [_IMAGE_KEY + robot.memory_camera]):
        raise UserError(
            f"{source} shows a video of {listed(config['history_image_keys'])}; here it is the"
            f" memory camera's, {robot.memory_camera!r} (embodiment.memory_camera)."
        )


def published_config(policy: SimpleMemVlaPolicy) -> dict[str, Any]:
    """The config.json of a policy, as its authors' code reads it."""
    sizes, robot, processor = policy.sizes, policy.embodiment, policy.config["processor"]
    head = {
        source_key: getattr(sizes.head, target_key) for source_key, target_key in HEAD_KEYS.items()
    }
    return {
        "model_type": NAME,
        "backbone_model_name_or_path": BASE,
        "backbone_config": sizes.qwen.to_dict(),
        "hidden_size": sizes.width,
        **{
            source_key: getattr(sizes, target_key)
            for source_key, target_key in BACKBONE_KEYS.items()
        },
        "use_proprio": bool(sizes.state_dim),
        "state_dim": sizes.state_dim or robot.state.width,
        **{
            name: list(value) if isinstance(value, tuple) else value for name, value in head.items()
        },
        "timestep_beta_beta": 1.0,
        "freeze_backbone": False,
        **{source_key: processor[target_key] for source_key, target_key in PROCESSOR_KEYS.items()},
        "image_keys": [_IMAGE_KEY + name for name in robot.camera_names],
        "history_image_keys": [_IMAGE_KEY + robot.memory_camera],
        "subtask_key": "subtask",
        "subtask_index_key": "subtask_online_index",
    }


# stats.json


def read_published_stats(folder: Path) -> NormStats | None:
    """The statistics of `stats.json`, where it is one of LeRobot's form.

    Only mean and deviation count for this policy. Where a file has no quantiles, a normal
    distribution's are taken.
    """
    if not (folder / STATS).is_file():
        return None
    data = read_json(
        checked_file(folder, STATS, "statistics"), "normalisation statistics", limit=2**24
    )
    features = {"state": data.get("observation.state"), "actions": data.get("action")}
    if not all(isinstance(feature, dict) for feature in features.values()):
        return None
    return NormStats(
        **{
            name: _stats(f"{folder / STATS}: {name}", feature or {})
            for name, feature in features.items()
        }
    )


def _stats(name: str, feature: Mapping[str, Any]) -> QuantileStats:
    values = {
        key: feature[key] for key in ("mean", "std", "q01", "q99", "min", "max") if key in feature
    }
    if {"mean", "std"} <= set(values) and not {"q01", "q99"} <= set(values):
        mean, std = (np.asarray(values[key], np.float64) for key in ("mean", "std"))
        values |= {
            "q01": (mean - _ONE_PERCENT * std).tolist(),
            "q99": (mean + _ONE_PERCENT * std).tolist(),
        }
    return QuantileStats.from_dict(values, name)


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
    (folder / CONFIG).write_text(json.dumps(published_config(target), indent=2) + "\n")
    if target.processor is not None:
        (folder / TOKENIZER_FILE).write_text(
            target.require_processor().tokenizer.content, encoding="utf-8"
        )
    elif (tokenizer := Path(str(target.config["processor"].get("tokenizer", "")))).is_file():
        shutil.copyfile(tokenizer, folder / TOKENIZER_FILE)
    if stats is not None:
        features = {"observation.state": stats.state.to_dict(), "action": stats.actions.to_dict()}
        (folder / STATS).write_text(json.dumps(features, indent=2) + "\n")
