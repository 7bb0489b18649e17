"""The processor files that LeRobot's commands look for beside exported weights of π0.5.

LeRobot's own π0.5 writes the state into the prompt; policies here, as the released ones, read the goal and a newline.
Of LeRobot's registered steps those are chosen that make the same words and numbers.
"""

import json
from pathlib import Path
from typing import Any

import torch

from mme_vla.errors import brief
from mme_vla.policy.mme import MMEPolicy
from mme_vla.processing.base import DEFAULT
from mme_vla.processing.normalisers import NormStats, QuantileStats
from mme_vla.processing.processor import Processor
from mme_vla.processing.prompt import PROMPTS, Plain
from mme_vla.processing.tokenizer import HUB
from mme_vla.registry import PROCESSORS

BEFORE, AFTER = "policy_preprocessor", "policy_postprocessor"
_QUANTILES = {"VISUAL": "IDENTITY", "STATE": "QUANTILES", "ACTION": "QUANTILES"}


def write_pipelines(policy: MMEPolicy, folder: Path, about: dict[str, Any], stats: NormStats | None) -> str | None:
    """Write both pipelines and their statistics, if LeRobot's steps can do what this policy's processor does.

    Args:
        about: LeRobot's `config.json`, whose features and relative actions they follow.

    Returns:
        None, or in words why there are none.
    """
    words = policy.config.get("processor") or {}
    tokenizer = str(words.get("tokenizer", ""))
    if stats is None:
        return "there are no normalisation statistics"
    if PROCESSORS[words.get("name", DEFAULT)] is not Processor or PROMPTS[words.get("prompt", "plain")] is not Plain:
        return "LeRobot has no step that writes this policy's prompt"
    if not tokenizer.startswith(HUB):
        return f"its tokenizer ({brief(tokenizer)}) is none that LeRobot could fetch from the hub"
    inputs, outputs = about["input_features"], about["output_features"]
    relative = {
        "enabled": about["use_relative_actions"],
        "exclude_joints": about["relative_exclude_joints"],
        "action_names": list(policy.embodiment.action.names),
    }
    reading = {
        "tokenizer_name": "/".join(tokenizer.removeprefix(HUB).split("/")[:2]), "max_length": words["prompt_length"],
        "task_key": "task", "padding_side": "right", "padding": "max_length", "truncation": True,
    }  # fmt: skip
    _write(folder, BEFORE, [
        ("rename_observations_processor", {"rename_map": {}}),
        ("to_batch_processor", {}),
        ("relative_actions_processor", relative),
        ("normalizer_processor", {"eps": 1e-8, "features": inputs | outputs, "norm_map": _QUANTILES}),
        ("pi0_new_line_processor", {}),
        ("tokenizer_processor", reading),
        ("device_processor", {"device": "cpu", "float_dtype": None}),
    ], stats)  # fmt: skip
    _write(folder, AFTER, [
        ("unnormalizer_processor", {"eps": 1e-8, "features": outputs, "norm_map": _QUANTILES}),
        ("absolute_actions_processor", {"enabled": about["use_relative_actions"]}),
        ("device_processor", {"device": "cpu", "float_dtype": None}),
    ], stats)  # fmt: skip
    return None


def _write(folder: Path, name: str, steps: list[tuple[str, dict[str, Any]]], stats: NormStats) -> None:
    from safetensors.torch import save_file

    described: list[dict[str, Any]] = []
    for i, (step, config) in enumerate(steps):
        described.append({"registry_name": step, "config": config})
        if "norm_map" in config:
            file = f"{name}_step_{i}_{step}.safetensors"
            save_file(_tensors(stats), folder / file)
            described[-1]["state_file"] = file
    (folder / f"{name}.json").write_text(json.dumps({"name": name, "steps": described}, indent=2) + "\n")


def _tensors(stats: NormStats) -> dict[str, torch.Tensor]:
    def named(feature: str, of: QuantileStats) -> dict[str, torch.Tensor]:
        return {f"{feature}.{key}": torch.tensor(value, dtype=torch.float32) for key, value in of.to_dict().items()}

    return named("observation.state", stats.state) | named("action", stats.actions)
