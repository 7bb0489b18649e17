"""Diffusion Policy's own checkpoints: `.pth` files {model, global_step, ckpt_manager}, `stats.json`
beside them.
"""

import json
import math
import re
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mme_vla.errors import UserError
from mme_vla.extras.methods.diffusion_policy.model import cell_centres
from mme_vla.extras.methods.diffusion_policy.policy import DiffusionPolicy
from mme_vla.policy.base import Policy
from mme_vla.policy.tensor_files import cast
from mme_vla.processing.normalise import NormStats
from mme_vla.utils import checked_file, read_json
from mme_vla.weights.tables import Adapter, Derived, Piece, wrong_policy

STATS = "stats.json"
WEIGHTS = "model.pth"
_WRAPPED = re.compile(
    r"^(?:module\.|_orig_mod\.|_checkpoint_wrapped_module\.)+|(?<=\.)_checkpoint_wrapped_module\."
)
_UNET, _LOCAL = "policy.", "backbone.unet."
_GRID = "image_pool.0.pos_grid"


def is_diffusion_policy(names: Iterable[str]) -> bool:
    """Whether tensors are named as in the authors' checkpoints, in whatever wrapping."""
    unwrapped_names = {unwrapped(name) for name in names}
    has_unet = any(name.startswith(f"{_UNET}down_modules.") for name in unwrapped_names)
    return has_unet and "image_pool.0.nets.weight" in unwrapped_names


def unwrapped(name: str) -> str:
    """A tensor's name without what data parallelism, compilation and activation checkpointing put
    before it.
    """
    return _WRAPPED.sub("", name)


def unwrap_names(tensors: Mapping[str, Tensor], source: str) -> dict[str, Tensor]:
    """Tensors by their names without wrapping."""
    renamed: dict[str, Tensor] = {}
    for name, tensor in tensors.items():
        if unwrapped(name) in renamed:
            raise UserError(f"{source} holds {unwrapped(name)} twice, once as {name}.")
        renamed[unwrapped(name)] = tensor
    return renamed


def diffusion_adapter(policy: Policy) -> Adapter:
    """The authors' names of this policy's tensors; a memory and its tower have none."""
    if not isinstance(policy, DiffusionPolicy):
        raise wrong_policy(policy, "Diffusion Policy", "model=diffusion_policy")
    table = {}
    for name in policy.state_dict():
        if policy.finetune_spec.component_of(name) not in ("memory", "vision"):
            table[name] = [Piece(name.replace(_LOCAL, _UNET).removeprefix("backbone."))]
    # The image encoder halves an image five times, rounding up.
    height, width = (math.ceil(side / 32) for side in policy.sizes.cropped)
    return Adapter(table, derived=[Derived(_GRID, partial(cell_centres, height, width))])


def read_diffusion_stats(folder: Path) -> NormStats | None:
    """The statistics of `stats.json`, where there is one: the authors write `action` where others
    write `actions`.
    """
    if not (folder / STATS).is_file():
        return None
    data = read_json(
        checked_file(folder, STATS, "statistics"), "normalisation statistics", limit=2**24
    )
    inner = data.get("norm_stats")
    if isinstance(inner, dict) and "action" in inner and "actions" not in inner:
        data = {"norm_stats": {**inner, "actions": inner["action"]}}
    try:
        return NormStats.from_dict(data)
    except UserError as error:
        raise UserError(f"{folder / STATS}: {error}") from None


def write_diffusion_policy(
    policy: Policy, folder: Path, dtype: torch.dtype, stats: NormStats | None
) -> None:
    """`model.pth` and `stats.json` as the authors' training writes them."""
    released = diffusion_adapter(policy).export(policy.state_dict())
    model = {name: cast(tensor.detach(), dtype).cpu() for name, tensor in released.items()}
    torch.save({"model": model, "global_step": 0, "ckpt_manager": {}}, folder / WEIGHTS)
    if stats is not None:
        inner: dict[str, Any] = stats.to_dict()["norm_stats"]
        statistics = {"norm_stats": {"state": inner["state"], "action": inner["actions"]}}
        (folder / STATS).write_text(json.dumps(statistics, indent=2) + "\n", encoding="utf-8")
