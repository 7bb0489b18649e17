"""What every foreign format shares: one policy's name table with its three short lists, applied strictly."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from mme_vla.backbone.pi05.backbone import Pi05Backbone
from mme_vla.errors import UserError
from mme_vla.policy.base import Policy
from mme_vla.policy.tensor_files import check_fit
from mme_vla.weights.name_tables import Derived, NameTable, Unread, check, read, write


@dataclass(frozen=True)
class Adapter:
    """How a foreign format names and lays out the tensors of one policy.

    table: our name → the foreign tensors it is made of.
    unread: foreign tensors, or layers of them, that no action reads: dropped when read, zeros when written.
    tied: foreign name → the foreign name it repeats: optional when read, written as a copy.
    derived: foreign constants that follow from the configuration: dropped when read, recomputed when written.
    fresh: our names that a checkpoint to start from may lack, beside the memory's: heads that are trained anew.
    """

    table: NameTable
    unread: list[Unread] = field(default_factory=list)
    tied: Mapping[str, str] = field(default_factory=dict)
    derived: list[Derived] = field(default_factory=list)
    fresh: frozenset[str] = frozenset()

    def needed(self) -> set[str]:
        """Foreign names without which the policy cannot be filled."""
        return {piece.path for pieces in self.table.values() for piece in pieces}

    def export(self, ours: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Write our tensors in the foreign names and layouts, the three lists included.

        Raises:
            UserError: the policy has tensors that this format has no name for.
        """
        homeless = sorted(set(ours) - set(self.table))
        if homeless:
            raise UserError(
                f"{len(homeless)} tensors have no name in this format: {', '.join(homeless)}. It holds memoryless "
                "policies without adapters: convert another policy, merge the adapters first, or choose another format."
            )
        theirs = write(self.table, self.unread, ours, self.derived)
        return theirs | {name: theirs[original] for name, original in self.tied.items()}

    def shapes(self, ours: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
        """Every foreign name but the derived ones, with its shape, where ours have the shapes of `ours`."""
        on_meta = {name: torch.empty_like(ours[name], device="meta") for name in self.table}
        theirs = write(self.table, self.unread, on_meta)
        theirs |= {name: theirs[original] for name, original in self.tied.items()}
        return {name: tuple(tensor.shape) for name, tensor in theirs.items()}

    def translate(self, theirs: Mapping[str, Tensor], ours: Mapping[str, Tensor], source: str) -> dict[str, Tensor]:
        """Read foreign tensors into our names; `ours` gives the shapes they must have.

        Raises:
            UserError: lists every foreign tensor that is missing, left over or misshapen; or a constant is another.
        """
        self.check_fit(theirs, ours, source)
        check(self.derived, theirs)
        derived = {constant.path for constant in self.derived}
        return read(self.table, {name: tensor for name, tensor in theirs.items() if name not in derived})

    def check_fit(self, theirs: Mapping[str, Tensor], ours: Mapping[str, Tensor], source: str) -> None:
        """Compare names and shapes alone, so that foreign tensors may still be on meta: not read yet.

        Raises:
            UserError: as `translate`.
        """
        shapes, derived = self.shapes(ours), {constant.path for constant in self.derived}
        found = {name: tensor for name, tensor in theirs.items() if name not in derived}
        check_fit(found, shapes, source, optional=set(shapes) - self.needed())


def pi05_of(policy: Policy) -> Pi05Backbone:
    """The policy's backbone, where it is π0.5: the only one these formats hold.

    Raises:
        UserError: it is another.
    """
    backbone = getattr(policy, "backbone", None)
    if not isinstance(backbone, Pi05Backbone):
        raise UserError(
            f"Checkpoints of LeRobot's π0.5, openpi and the released trees hold π0.5; this policy's backbone is "
            f"{type(backbone or policy).__name__}."
        )
    return backbone


def memory_parameters(policy: Policy) -> set[str]:
    """Names of the tensors a policy has beyond memoryless π0.5: memory, integration, and the memory's own expert."""
    return {name for name in policy.state_dict() if policy.part_of(name) == "memory"}
