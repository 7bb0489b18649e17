"""Putting backbone, memory and integration together: a memory for a backbone, and whether it can stand in time."""

from collections.abc import Mapping, Set
from typing import Any

from mme_vla.backbone.base import Backbone
from mme_vla.errors import UserError
from mme_vla.integration.base import Integration, doors_of
from mme_vla.memory.base import Memory
from mme_vla.registry import MEMORIES


def build_memory(section: Mapping[str, Any], backbone: Backbone, width: int) -> Memory:
    """The memory of a configuration for this backbone's vision tokens; its own tokens are `width` wide.

    Raises:
        UserError: an unknown memory or option, or a grid to which the backbone's cannot be pooled.
    """
    memory: Memory = MEMORIES.build(section, d_vision=backbone.vision_width, width=width)
    memory.check_grid(backbone.grid)
    return memory


def check_positions(config: Mapping[str, Any], integration: Integration, memory: Memory, hosts: Set[str]) -> None:
    """Make sure that a memory that shall be placed in time can be: its tokens have one, the backbone a place for it."""
    if integration.memory_position != "time":
        return
    if not memory.timed:
        raise UserError(
            f"integration.memory_position=time: the tokens of the memory {config['memory']['name']!r} stand for no one "
            "moment each. Take memory_position=slot, or a memory that says `timed`."
        )
    if "blocks" in doors_of(type(integration)) and "positions" not in hosts:
        raise UserError(
            f"integration.memory_position=time: the backbone {config['backbone']['name']!r} has no place for blocks at "
            "positions of their own. Take memory_position=slot, or integration=modulator where it hosts that."
        )
