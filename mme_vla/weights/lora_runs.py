"""Runs of OpenVLA-OFT that keep their adapters apart: `lora_adapter/`, as peft writes it, beside head and numbers."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from mme_vla.errors import UserError, brief, listed
from mme_vla.files import inside, read_json
from mme_vla.policy.tensor_files import read_files
from mme_vla.weights.names.openvla import VLA

FOLDER, FILE, SETTINGS = "lora_adapter", "adapter_model.safetensors", "adapter_config.json"
_BEFORE, _DOWN, _UP = "base_model.model.", ".lora_A.weight", ".lora_B.weight"


def has_adapters(folder: Path) -> bool:
    """Whether a run's adapters lie in it."""
    return (folder / FOLDER / FILE).is_file()


def named_base(folder: Path) -> str:
    """What a run says its adapters were trained on; for messages alone."""
    said = _settings(folder).get("base_model_name_or_path")
    return said if isinstance(said, str) and said else "its base model"


def merged(base: Mapping[str, Tensor], folder: Path) -> dict[str, Tensor]:
    """The base's tensors (behind `vla/`) with a run's adapters folded in: W + (alpha / rank)·B·A.

    Raises:
        UserError: the adapters are damaged, of another base, or of a kind that is more than that sum.
    """
    settings, file = _settings(folder), folder / FOLDER / FILE
    rank, alpha = settings.get("r"), settings.get("lora_alpha")
    if not isinstance(rank, int) or not isinstance(alpha, int | float) or rank < 1:
        raise UserError(f"{folder / FOLDER / SETTINGS} says r={brief(rank)}, lora_alpha={brief(alpha)}: no LoRA's.")
    if other := [name for name in ("use_dora", "use_rslora", "rank_pattern", "alpha_pattern") if settings.get(name)]:
        raise UserError(f"{folder / FOLDER / SETTINGS} sets {listed(other)}, which are not read: merge it with peft.")
    adapters = read_files(folder / FOLDER, (file,))
    downs = [name for name in adapters if name.startswith(_BEFORE) and name.endswith(_DOWN)]
    odd = sorted(set(adapters) - set(downs) - {name.removesuffix(_DOWN) + _UP for name in downs})
    if odd or not downs:
        raise UserError(f"{file} holds {listed(odd or list(adapters))}, no adapters of OpenVLA-OFT.")
    out = dict(base)
    for name in downs:
        target = VLA + name.removeprefix(_BEFORE).removesuffix(_DOWN) + ".weight"
        up = adapters.get(name.removesuffix(_DOWN) + _UP)
        down = adapters[name].float().flatten(1)
        if target not in out or up is None or up.shape[1:2] != down.shape[:1] or len(down) != rank:
            raise UserError(f"{file}: {name} fits no matrix of the base model: it was trained on another base.")
        # A convolution's A is [r, in, k, k] and its B [out, r, 1, 1]: the product of their rows and columns.
        product = up.float().flatten(1) @ down
        weight = out[target]
        if product.shape != weight.flatten(1).shape:
            raise UserError(f"{file}: {name} makes {list(product.shape)} of {list(weight.shape)}: another base's.")
        out[target] = (weight.float() + alpha / rank * product.view_as(weight)).to(weight.dtype)
    return out


def _settings(folder: Path) -> dict[str, Any]:
    place = inside(folder / FOLDER, SETTINGS, "adapters")
    found: dict[str, Any] = read_json(place, "a LoRA's settings", limit=2**20)
    return found
