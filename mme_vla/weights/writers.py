"""A policy as a folder that another library loads: one writer a format."""

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor

from mme_vla.embodiment import ActionSpace
from mme_vla.errors import UserError, brief, listed, require
from mme_vla.policy.base import Policy
from mme_vla.policy.mme import MMEPolicy, mme_of
from mme_vla.policy.sections import PolicySections
from mme_vla.policy.tensor_files import WEIGHTS, cast
from mme_vla.processing.base import DEFAULT
from mme_vla.processing.normalise import NormStats
from mme_vla.processing.processor import STATS_FILE, Processor
from mme_vla.processing.prompt import PROMPTS, GoalPrompt
from mme_vla.processing.tokenizer import HUB
from mme_vla.registry import PROCESSORS
from mme_vla.utils import write_json
from mme_vla.weights.names.torch_backbone import EMBEDDING
from mme_vla.weights.orbax import VARIANT_FILE, write_orbax
from mme_vla.weights.ports import to_lerobot, to_openpi
from mme_vla.weights.released import released_table, to_released
from mme_vla.weights.source import VARIANTS, method_formats

BEFORE, AFTER = "policy_preprocessor", "policy_postprocessor"
_QUANTILES = {"VISUAL": "IDENTITY", "STATE": "QUANTILES", "ACTION": "QUANTILES"}


def write_pipelines(
    policy: MMEPolicy, folder: Path, about: dict[str, Any], stats: NormStats | None
) -> str | None:
    """Write both pipelines and their statistics, if LeRobot's steps can do what this policy's
    processor does.

    Args:
        about: LeRobot's `config.json`, whose features and relative actions they follow.

    Returns:
        None, or in words why there are none.
    """
    if stats is None:
        return "there are no normalisation statistics"
    words = PolicySections.of(policy.config).processor
    processor = PROCESSORS[words.get("name", DEFAULT)]
    prompt = PROMPTS[words.get("prompt", "plain")]
    if processor is not Processor or prompt is not GoalPrompt:
        return "LeRobot has no step that writes this policy's prompt"
    tokenizer = str(words.get("tokenizer", ""))
    if not tokenizer.startswith(HUB):
        return f"its tokenizer ({brief(tokenizer)}) is none that LeRobot could fetch from the hub"
    inputs = about["input_features"]
    outputs = about["output_features"]
    relative = {
        "enabled": about["use_relative_actions"],
        "exclude_joints": about["relative_exclude_joints"],
        "action_names": list(policy.embodiment.action.names),
    }
    reading = {
        "tokenizer_name": "/".join(tokenizer.removeprefix(HUB).split("/")[:2]),
        "max_length": words["prompt_length"],
        "task_key": "task",
        "padding_side": "right",
        "padding": "max_length",
        "truncation": True,
    }
    normalise = {"eps": 1e-8, "features": inputs | outputs, "norm_map": _QUANTILES}
    unnormalise = {"eps": 1e-8, "features": outputs, "norm_map": _QUANTILES}
    on_cpu = {"device": "cpu", "float_dtype": None}
    before: list[Step] = [
        ("rename_observations_processor", {"rename_map": {}}),
        ("to_batch_processor", {}),
        ("relative_actions_processor", relative),
        ("normalizer_processor", normalise),
        ("pi0_new_line_processor", {}),
        ("tokenizer_processor", reading),
        ("device_processor", on_cpu),
    ]
    after: list[Step] = [
        ("unnormalizer_processor", unnormalise),
        ("absolute_actions_processor", {"enabled": about["use_relative_actions"]}),
        ("device_processor", on_cpu),
    ]
    _write(folder, BEFORE, before, stats)
    _write(folder, AFTER, after, stats)
    return None


Step = tuple[str, dict[str, Any]]
"""A step of a pipeline: LeRobot's name of it, and its settings."""


def _write(folder: Path, name: str, steps: list[Step], stats: NormStats) -> None:
    tensors = {}
    for feature, values in (("observation.state", stats.state), ("action", stats.actions)):
        for key, value in values.to_dict().items():
            tensors[f"{feature}.{key}"] = torch.tensor(value, dtype=torch.float32)
    described: list[dict[str, Any]] = []
    for i, (step, config) in enumerate(steps):
        about: dict[str, Any] = {"registry_name": step, "config": config}
        if "norm_map" in config:
            about["state_file"] = f"{name}_step_{i}_{step}.safetensors"
            save_file(tensors, folder / about["state_file"])
        described.append(about)
    write_json(folder / f"{name}.json", {"name": name, "steps": described})


ASSET = "robomme"  # the name under which openpi's layout keeps a dataset's statistics
_SIZES = {"paligemma_variant": "gemma_2b", "action_expert_variant": "gemma_300m"}


def check_target(policy: Policy, fmt: str) -> None:
    """Refuse a format that has no place for this policy, before anything is read."""
    if fmt in ("lerobot", "openpi") and policy.memory is not None:
        raise UserError(
            f"The format {fmt!r} holds memoryless π0.5 only: it has no names for a memory's"
            " parameters."
        )
    if fmt == "lerobot":
        # LeRobot searches each absolute number's name in all names.
        action = policy.embodiment.action
        searched = [name.lower() for name in _absolute(action) if name]
        for i, name in enumerate(action.names):
            is_absolute = any(text in name.lower() for text in searched)
            require(
                not action.relative or is_absolute == (i not in action.relative),
                f"LeRobot tells absolute actions by parts of names ({listed(searched)}), and would"
                f" mistake number {i}, {name!r}: choose embodiment.action.names in which no"
                " absolute number's name is part of a relative one's.",
            )
    if fmt == "released":
        released_table(mme_of(policy, "The released layout"))
    if fmt in method_formats():
        method_formats()[fmt].function("adapter")(policy)


def _absolute(action: ActionSpace) -> list[str]:
    return [name for i, name in enumerate(action.names) if i not in action.relative]


def write_native(policy: Policy, folder: Path, dtype: torch.dtype, stats: NormStats | None) -> None:
    """`save_pretrained`; the processor carries the statistics."""
    policy.save_pretrained(folder, dtype=_name(dtype))


def write_lerobot(
    policy: Policy, folder: Path, dtype: torch.dtype, stats: NormStats | None
) -> None:
    """Weights, `config.json` and processors for LeRobot's `PI05Policy`; statistics as openpi writes
    them, beside them.

    LeRobot adds the state of the moment to relative actions, also to later ones of a chunk: where
    there are such, the folder says that one action of a chunk is executed. Cameras are called as in
    LeRobot's RoboMME environment.
    """
    policy = mme_of(policy, "LeRobot's layout of π0.5")
    size = policy.backbone.image_size
    robot = policy.embodiment
    features: dict[str, Any] = {}
    for camera in robot.cameras:
        features[camera.lerobot_key] = {"type": "VISUAL", "shape": [3, size, size]}
    features["observation.state"] = {"type": "STATE", "shape": [robot.state.width]}
    about = {
        "type": "pi05",
        "n_obs_steps": 1,
        "input_features": features,
        "output_features": {"action": {"type": "ACTION", "shape": [robot.action.width]}},
        **_SIZES,
        "dtype": _name(dtype),
        "chunk_size": policy.horizon,
        "n_action_steps": 1 if robot.action.relative else robot.action.execute,
        "max_state_dim": policy.action_dim,
        "max_action_dim": policy.action_dim,
        "image_resolution": [size, size],
        # Of RoboMME's Panda: joints against the current state, the gripper as it is.
        "use_relative_actions": bool(robot.action.relative),
        "relative_exclude_joints": _absolute(robot.action),
    }
    write_json(folder / "config.json", about)
    reason = write_pipelines(policy, folder, about, stats)
    if reason is not None:
        warnings.warn(
            f"Written without processors: {reason}. LeRobot's commands cannot open it;"
            " PI05Policy.from_pretrained can.",
            stacklevel=2,
        )
    _write_safetensors(to_lerobot(policy, policy.state_dict()), folder, dtype)
    if stats is not None:
        stats.save(folder / STATS_FILE)


def write_openpi(policy: Policy, folder: Path, dtype: torch.dtype, stats: NormStats | None) -> None:
    """Weights, `config.json` and statistics as openpi's PyTorch training writes them."""
    policy = mme_of(policy, "openpi's layout of π0.5")
    about = {
        "action_dim": policy.action_dim,
        "action_horizon": policy.horizon,
        **_SIZES,
        "precision": _name(dtype),
    }
    write_json(folder / "config.json", about)
    tensors = to_openpi(policy, policy.state_dict())
    # of a tied pair, safetensors' save_model keeps the first name; its load_model wants no more
    del tensors[EMBEDDING]
    _write_safetensors(tensors, folder, dtype)
    _write_assets(folder, stats)


def write_released(
    policy: Policy, folder: Path, dtype: torch.dtype, stats: NormStats | None
) -> None:
    """A run with one step, 0, as the released JAX code lays it out."""
    policy = mme_of(policy, "The released layout")
    sections = PolicySections.of(policy.config)
    name = str(sections.name)
    if policy.memory is not None:  # its parts may be others than the name says
        integration = sections.integration["name"].replace("modulator", "modul")
        name = f"{sections.memory['name']}_{integration}"
    for variant, target in VARIANTS.items():
        if target == name and name != "pi05":  # the memoryless baseline has no such file
            (folder / VARIANT_FILE).write_text(f"{variant}.yaml\n", encoding="utf-8")
    tree = {leaf: cast(tensor, dtype) for leaf, tensor in to_released(policy).items()}
    write_orbax(tree, folder / "0" / "params")
    _write_assets(folder / "0", stats)


_WRITERS: dict[str, Callable[[Policy, Path, torch.dtype, NormStats | None], None]] = {
    "ours": write_native,
    "lerobot": write_lerobot,
    "openpi": write_openpi,
    "released": write_released,
}


def write_policy(
    policy: Policy, folder: Path, fmt: str, dtype: torch.dtype, stats: NormStats | None
) -> None:
    """Write a policy into `folder` in a format of `formats()`."""
    if fmt in _WRITERS:
        _WRITERS[fmt](policy, folder, dtype, stats)
    else:
        method_formats()[fmt].function("write")(policy, folder, dtype, stats)


def _write_safetensors(tensors: Mapping[str, Tensor], folder: Path, dtype: torch.dtype) -> None:
    """Write one file, as those libraries read it; a tensor under two names is written twice."""
    storages: set[int] = set()
    apart = {}
    for name, tensor in tensors.items():
        tensor = cast(tensor.detach(), dtype).cpu()
        place = tensor.data_ptr()
        if place in storages:
            tensor = tensor.clone()
        storages.add(place)
        apart[name] = tensor
    save_file(apart, folder / WEIGHTS, metadata={"format": "pt"})


def _write_assets(folder: Path, stats: NormStats | None) -> None:
    if stats is not None:
        (folder / "assets" / ASSET).mkdir(parents=True)
        stats.save(folder / "assets" / ASSET / STATS_FILE)


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
