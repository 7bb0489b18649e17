"""The released (JAX) parameter trees: names to ours and back, for any composition whose rooms supply a name table.

Leaves are named without the leading `params/` and the trailing `/value`; layers are stacked on the first axis.
`orbax.py` reads and writes the files.
"""

from collections.abc import Mapping

from torch import Tensor

import mme_vla.weights.names.jax_backbone as backbone_names
import mme_vla.weights.names.jax_integration as integration_names
import mme_vla.weights.names.jax_memory as memory_names
from mme_vla.errors import UserError
from mme_vla.policy.mme import MMEPolicy
from mme_vla.policy.tensor_files import assign_tensors
from mme_vla.weights.adapter import Adapter
from mme_vla.weights.name_tables import Derived, NameTable, Unread, prefixed


def released_adapter(policy: MMEPolicy) -> Adapter:
    """The released tree of this policy.

    Raises:
        UserError: the memory is not one of the released ones.
    """
    return Adapter(released_table(policy), released_unread(policy), derived=released_derived(policy))


def partial_adapter(policy: MMEPolicy) -> Adapter:
    """The released tree as far as it has names for this policy: a memory of one's own is left out."""
    table = _backbone_table(policy) | (_memory_table(policy) or {})
    return Adapter(table, released_unread(policy), derived=released_derived(policy))


def released_table(policy: MMEPolicy) -> NameTable:
    """Every parameter of the policy and the released leaves it is made of.

    Raises:
        UserError: the memory is not one of the released ones.
    """
    memory = _memory_table(policy)
    if memory is None:
        raise UserError(f"{type(policy.memory).__name__} has no released names: only released memories convert.")
    return _backbone_table(policy) | memory


def _backbone_table(policy: MMEPolicy) -> NameTable:
    table = prefixed("backbone", backbone_names.released_names(policy.backbone))
    return table | prefixed("integration", integration_names.released_names(policy.integration))


def _memory_table(policy: MMEPolicy) -> NameTable | None:
    if policy.memory is None:
        return {}
    names = memory_names.released_names(policy.memory)
    return None if names is None else prefixed("memory", names)


def released_unread(policy: MMEPolicy) -> list[Unread]:
    """Released leaves, or layers of them, that no action reads and this library does not hold."""
    return backbone_names.released_unread(policy.backbone) + memory_names.released_unread(policy.memory)


def released_derived(policy: MMEPolicy) -> list[Derived]:
    """Released leaves that follow from the configuration: dropped when read, recomputed when written."""
    return memory_names.released_derived(policy.memory)


def from_released(policy: MMEPolicy, tree: Mapping[str, Tensor], source: str = "the released tree") -> MMEPolicy:
    """Fill a policy (on meta or not) from a released tree.

    Raises:
        UserError: lists every leaf that is missing, left over or misshapen.
    """
    assign_tensors(policy, released_adapter(policy).translate(tree, policy.state_dict(), source), source)
    return policy


def to_released(policy: MMEPolicy) -> dict[str, Tensor]:
    """Write a policy as a released tree; what no action reads is filled with zeros."""
    return released_adapter(policy).export(policy.state_dict())
