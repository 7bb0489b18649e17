"""The released (JAX) parameter trees: names to ours and back, for any composition whose packages
supply a name table.

Leaves are named without the leading `params/` and the trailing `/value`; layers are stacked on the
first axis. `orbax.py` reads and writes the files.
"""

from typing import Any

from torch import Tensor

import mme_vla.weights.names.jax_backbone as backbone_names
import mme_vla.weights.names.jax_integration as integration_names
import mme_vla.weights.names.jax_memory as memory_names
from mme_vla.errors import UserError, listed
from mme_vla.policy.mme import MMEPolicy
from mme_vla.weights.tables import (
    Adapter,
    NameTable,
    memory_parameters,
    pi05_of,
    prefixed,
)

OF_MEMORY = r"(^|/)mem_|_mem(/|$)"
"""Leaves that a memory of the released code adds to π0.5."""


def released_adapter(policy: MMEPolicy) -> Adapter:
    """The released tree, where it has names for the whole policy."""
    return _adapter(policy, released_table(policy))


def partial_adapter(policy: Any) -> Adapter:
    """The released tree as far as it has names for this policy: what parts of one's own have beyond
    it is left out.
    """
    state = policy.state_dict()
    known = {}
    for name, pieces in _table(policy).items():
        if name in state or policy.finetune_spec.component_of(name) != "memory":
            known[name] = pieces
    return _adapter(policy, known)


def _adapter(policy: MMEPolicy, table: NameTable) -> Adapter:
    unread = backbone_names.released_unread(pi05_of(policy))
    unread += memory_names.released_unread(policy.memory)
    derived = memory_names.released_derived(policy.memory)
    return Adapter(table, unread, derived=derived, of_memory=OF_MEMORY)


def released_table(policy: MMEPolicy) -> NameTable:
    """Every parameter of the policy and the released leaves it is made of."""
    table = _table(policy)
    component_of = policy.finetune_spec.component_of
    named = {name for name in table if component_of(name) == "memory"}
    unnamed = sorted(memory_parameters(policy) ^ named)
    if unnamed:
        owners = type(policy.integration).__name__
        if policy.memory is not None:
            owners = f"{type(policy.memory).__name__} with {owners}"
        raise UserError(
            f"{owners} has no released names for"
            f" {len(unnamed)} tensors ({listed(unnamed)}): only the released memories and"
            " integrations convert whole. To begin training from a released checkpoint use"
            " start_from() (on the command line: init_from=…), which leaves these as they are."
        )
    return table


def _table(policy: MMEPolicy) -> NameTable:
    table = prefixed("backbone", backbone_names.released_names(pi05_of(policy)))
    table |= prefixed("integration", integration_names.released_names(policy.integration))
    if policy.memory is None:
        return table
    return table | prefixed("memory", memory_names.released_names(policy.memory))


def to_released(policy: MMEPolicy) -> dict[str, Tensor]:
    """Write a policy as a released tree; what no action reads is filled with zeros."""
    return released_adapter(policy).export(policy.state_dict())
