"""SAM2Act's own checkpoints: `.pth` files {epoch, model_state, optimizer_state, lr_sched_state}."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import torch
from torch import Tensor

from mme_vla.errors import UserError
from mme_vla.methods.sam2act import names as names
from mme_vla.methods.sam2act.policy import SAM2ActPolicy
from mme_vla.policy.base import Policy
from mme_vla.policy.tensor_files import cast
from mme_vla.processing.normalise import NormStats
from mme_vla.weights.tables import Adapter, prefixed

WEIGHTS = "model_plus_last.pth"
_WRAPPED = "module."


def is_sam2act(names: Iterable[str]) -> bool:
    """Whether tensors are named as in the authors' checkpoints, in whatever wrapping."""
    unwrapped = {name.removeprefix(_WRAPPED) for name in names}
    return {"mvt1.pos_encoding", "mvt2.pos_encoding"} <= unwrapped


def unwrap_sam2act_names(tensors: Mapping[str, Tensor], source: str) -> dict[str, Tensor]:
    """Tensors by their names without wrapping, each copy of SAM2's compared with the original."""
    renamed = {name.removeprefix(_WRAPPED): tensor for name, tensor in tensors.items()}
    for copy, original in names.released_copies(renamed).items():
        if copy in renamed and not torch.equal(renamed[copy], renamed[original]):
            raise UserError(f"{source}: {copy} is another tensor than {original}, of which it should be a copy.")
    return renamed


def sam2act_adapter(policy: Policy) -> Adapter:
    """The authors' names of this policy's tensors."""
    if not isinstance(policy, SAM2ActPolicy):
        raise UserError(
            f"This format holds SAM2Act+; {policy.config.get('name', 'this')} is a {type(policy).__name__}. "
            "Set model=sam2act_plus."
        )
    sizes = policy.backbone.sizes
    table = names.released_names(policy.backbone.state_dict(), sizes.mask_stages)
    unread = names.released_unread(sizes.encoder.neck)
    originals = [piece.path for pieces in table.values() for piece in pieces] + [gap.path for gap in unread]
    return Adapter(
        prefixed("backbone", table),
        unread,
        names.released_copies(originals),
        names.released_constants(sizes.feature),
    )


def write_sam2act(policy: Policy, folder: Path, dtype: torch.dtype, stats: NormStats | None) -> None:
    """`model_plus_last.pth` as the authors' training writes it, but for the optimizer's state."""
    released = sam2act_adapter(policy).export(policy.state_dict())
    model = {name: cast(tensor.detach(), dtype).cpu() for name, tensor in released.items()}
    torch.save({"epoch": 0, "model_state": model, "optimizer_state": {}, "lr_sched_state": {}}, folder / WEIGHTS)
