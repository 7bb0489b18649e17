"""The released (JAX) parameter trees: names to ours and back, for any composition whose rooms supply a name table.

Leaves are named without the leading `params/` and the trailing `/value`; layers are stacked on the first axis.
"""

from collections.abc import Mapping

from torch import Tensor

import mme_vla.backbone.names as backbone_names
import mme_vla.integration.names as integration_names
import mme_vla.memory.names as memory_names
from mme_vla.errors import UserError
from mme_vla.naming import Derived, NameTable, Unread, check, prefixed, read, write
from mme_vla.policy import MMEPolicy
from mme_vla.pretrained import assign_tensors


def released_table(policy: MMEPolicy) -> NameTable:
    """Every parameter of the policy and the released leaves it is made of.

    Raises:
        UserError: the memory is not one of the released ones.
    """
    table = prefixed("backbone", backbone_names.released_names(policy.backbone))
    table |= prefixed("integration", integration_names.released_names(policy.integration))
    if policy.memory is not None:
        names = memory_names.released_names(policy.memory)
        if names is None:
            raise UserError(f"{type(policy.memory).__name__} has no released names: only released memories convert.")
        table |= prefixed("memory", names)
    return table


def released_unread(policy: MMEPolicy) -> list[Unread]:
    """Released leaves, or layers of them, that no action reads and this library does not hold."""
    return backbone_names.released_unread(policy.backbone) + memory_names.released_unread(policy.memory)


def released_derived(policy: MMEPolicy) -> list[Derived]:
    """Released leaves that follow from the configuration: dropped when read, recomputed when written."""
    return memory_names.released_derived(policy.memory)


def from_released(policy: MMEPolicy, tree: Mapping[str, Tensor]) -> MMEPolicy:
    """Fill a policy (on meta or not) from a released tree.

    Raises:
        UserError: lists every leaf that is missing, left over or misshapen.
    """
    table = released_table(policy)
    known = {piece.path for pieces in table.values() for piece in pieces} | {u.path for u in released_unread(policy)}
    extra = sorted(set(tree) - known - {d.path for d in released_derived(policy)})
    if extra:
        raise UserError(f"The checkpoint holds {len(extra)} tensors this policy has no place for: {', '.join(extra)}")
    check(released_derived(policy), tree)
    assign_tensors(policy, read(table, tree), "the released tree")
    return policy


def to_released(policy: MMEPolicy) -> dict[str, Tensor]:
    """Write a policy as a released tree; what no action reads is filled with zeros."""
    return write(released_table(policy), released_unread(policy), policy.state_dict(), released_derived(policy))
